"""MAVLink 2 signing: who knows the key may speak, and nobody can say the same thing twice.

mavlink.io/en/guide/message_signing.html: the last 13 bytes of a frame are a link number, a time
stamp of 48 bits (10 us since 2015) and the first 48 bits of a SHA-256 over key, frame and both.
A stamp must grow with every frame of a stream, across restarts too. A small computer has no
clock that survives a power cut, so the last stamp is kept in a file and learnt from others.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path

from companion.errors import LinkError
from companion.link.messages import RADIO_STATUS
from companion.link.parameters import DamagedStateError, read_state, write_state

_logger = logging.getLogger(__name__)

_SIGNED = 0x01
_TAIL = 13
_EPOCH_2015_S = 1_420_070_400
_PER_S = 100_000
# A stream that is new may be behind our own time by a minute, as the guide has it.
_BEHIND_MAX = 60 * _PER_S
_STREAMS_MAX = 64
# The file is written this often with a time that far ahead: after a crash no stamp is used twice,
# and a jump of some seconds refuses nobody.
_KEEP_S = 5.0
_AHEAD = 10 * _PER_S
# A stamp has 48 bits.
_STAMP_MAX = 1 << 48
_DISK_MAX_S = 2.0
STATE_NAME = "signing.json"


def read_key(path: Path) -> bytes:
    """Return the 32 bytes of the key in `path`; raises a `LinkError` of one line.

    32 bytes as they are, 64 hexadecimal digits, or a passphrase, of which the SHA-256 is the key
    as MAVProxy and Mission Planner have it.
    """
    where = f"link.signing_key_file = {str(path)!r}"
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if not stat.S_ISREG(mode):
                raise LinkError(f"{where}: no file; give the path of the key")
            if mode & 0o077:
                raise LinkError(
                    f"{where}: others may read it (mode {stat.S_IMODE(mode):04o}); chmod 600 {path}"
                )
            content = file.read(1025)
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise LinkError(f"{where}: {reason}; give the path of the key") from error
    key = _key_of(content)
    if key is None:
        raise LinkError(
            f"{where}: {len(content)} bytes are not a key; write 32 bytes, 64 hexadecimal digits "
            "or a passphrase in one line"
        )
    return key


def _key_of(content: bytes) -> bytes | None:
    line = content.strip(b"\r\n")
    is_text = bool(line) and line.isascii() and all(32 <= byte < 127 for byte in line)
    if len(content) == 32 and not is_text:
        return content
    if len(content) > 1024 or not is_text:
        return None
    text = line.decode("ascii").strip()
    if len(text) == 64 and all(digit in "0123456789abcdefABCDEF" for digit in text):
        return bytes.fromhex(text)
    return hashlib.sha256(text.encode()).digest() if len(text) >= 8 else None


def _kept_stamp(path: Path) -> int:
    """Return the stamp that was kept, 0 where none ever was.

    Of a damaged file the time at which it was written is left: no stamp that was given before is
    later than that and what was written ahead, unless others were ahead of this computer's clock,
    and from them the stamp is learnt again.
    """
    try:
        values = read_state(path)
        stamp = values.get("stamp", -1.0) if values or path.exists() else 0.0
        if 0.0 <= stamp < _STAMP_MAX:
            return round(stamp)
    except DamagedStateError:
        pass
    written_s = path.stat().st_mtime
    _logger.warning(
        "%s: damaged; the stamp of signing goes on from the computer's clock, or from when the "
        "file was written where that is later",
        path,
    )
    return min(_stamp_at(written_s) + _AHEAD, _STAMP_MAX // 2)


def _stamp_at(utc_s: float) -> int:
    return max(0, round((utc_s - _EPOCH_2015_S) * _PER_S))


class Signing:
    """Judges what comes in and stamps what goes out."""

    def __init__(
        self,
        key: bytes,
        *,
        state_folder: Path | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.key = key
        self._state = None if state_folder is None else state_folder / STATE_NAME
        self._clock = clock
        self._streams: dict[tuple[int, int, int], int] = {}
        self._kept = 0
        self.bad_count = 0
        self.unsigned_count = 0
        self.old_count = 0
        before = 0 if self._state is None else _kept_stamp(self._state)
        self._stamp = max(before, self._now())
        self._writing: threading.Thread | None = None
        if self._state is not None:
            write_state(self._state, {"stamp": float(self._stamp + _AHEAD)})
            self._kept = self._stamp

    def _now(self) -> int:
        return _stamp_at(self._clock())

    def next_stamp(self) -> int:
        """Return a stamp that was never given before."""
        self._stamp = max(self._stamp + 1, self._now())
        return self._stamp

    def accepts(self, frame: bytes, message_id: int) -> bool:
        """Whether a frame may be believed; unsigned it may only be the radio's own report."""
        if frame[0] != 0xFD or not frame[2] & _SIGNED:
            if message_id == RADIO_STATUS:
                return True
            self.unsigned_count += 1
            return False
        signature = hashlib.sha256(self.key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(signature, frame[-6:]):
            self.bad_count += 1
            return False
        stamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[5], frame[6], frame[-_TAIL])
        if not self._is_new(stream, stamp):
            self.old_count += 1
            return False
        self._streams[stream] = stamp
        self._stamp = max(self._stamp, stamp)
        return True

    def _is_new(self, stream: tuple[int, int, int], stamp: int) -> bool:
        last = self._streams.get(stream)
        if last is not None:
            return stamp > last
        # Only who has the key can fill the table, and more streams than these no link has.
        return len(self._streams) < _STREAMS_MAX and stamp >= self._stamp - _BEHIND_MAX

    def keep(self, *, is_last: bool = False) -> None:
        """Write the stamp down now and then; called from the control loop, so it waits for no disk.

        The disk is waited for in a thread of its own, and at the end. While a slow one still
        takes the stamp before, there is none to write.
        """
        if self._state is None or not (is_last or self._stamp >= self._kept + _KEEP_S * _PER_S):
            return
        if is_last:
            self.wait_until_kept()
            write_state(self._state, {"stamp": float(self._stamp)})
        elif self._writing is None or not self._writing.is_alive():
            values = {"stamp": float(self._stamp + _AHEAD)}
            # A daemon: a disk that hangs does not hold up the end of the program.
            self._writing = threading.Thread(
                target=write_state, args=(self._state, values), name="signing", daemon=True
            )
            self._writing.start()
            self._kept = self._stamp

    def wait_until_kept(self) -> None:
        """Wait until the disk has what was written, but not for one that hangs."""
        if self._writing is not None:
            self._writing.join(_DISK_MAX_S)

    @property
    def refused_count(self) -> int:
        """Return how many sound frames were not believed."""
        return self.bad_count + self.unsigned_count + self.old_count

"""MAVLink 2 signing: who knows the key may speak, and nobody can say the same thing twice.

mavlink.io/en/guide/message_signing.html: the last 13 bytes of a frame are a link number, a time
stamp of 48 bits (10 us since 2015) and the first 48 bits of a SHA-256 over key, frame and both.
A stamp must grow with every frame of a stream, across restarts too. A small computer has no
clock that survives a power cut, so the last stamps are kept in a file and learnt from others.

Nothing signed allows spraying before somebody with the key has said back a random number that this
start has asked (TIMESYNC): what was said before that is then known to be old, whatever the clocks
say. An order to open is obeyed once its stamp is on disk, so that no later start obeys it again.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import stat
import struct
import threading
import time
from collections import deque
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
# Of those that were kept the newest leave room for others.
_KEPT_MAX = 32
_TIMESYNC = 111
# An autopilot that leaves so many questions unanswered answers none (TIMESYNC is asked at 1 Hz).
_ASKED_MAX = 5
# The file is written this often with a time that far ahead: after a crash no stamp is used twice,
# and a jump of some seconds refuses nobody.
_KEEP_S = 5.0
_AHEAD = 10 * _PER_S
# A stamp has 48 bits.
_STAMP_MAX = 1 << 48
_DISK_MAX_S = 2.0
STATE_NAME = "signing.json"
# Names in the file, beside `system/component/link` for each stream.
_OURS, _FLOOR = "stamp", "floor"


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


def _read_kept(path: Path) -> dict[str, int]:
    """Return the stamps that were kept: ours, that of each stream, and the floor of all others.

    Without a floor the file is none to rely on. Of a damaged one the time at which it was written
    is left: no stamp that was given before is later than that and what was written ahead, unless
    others were ahead of this computer's clock, and from them the stamp is learnt again.
    """
    try:
        kept = {name: round(stamp) for name, stamp in read_state(path).items()}
        if all(0 <= stamp < _STAMP_MAX for stamp in kept.values()) and (
            _OURS in kept or not path.exists()
        ):
            return kept
    except DamagedStateError:
        pass
    written_s = path.stat().st_mtime
    _logger.warning(
        "%s: damaged; the stamp of signing goes on from the computer's clock, or from when the "
        "file was written where that is later",
        path,
    )
    return {_OURS: min(_stamp_at(written_s) + _AHEAD, _STAMP_MAX // 2)}


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
        kept = {} if self._state is None else _read_kept(self._state)
        ours = kept.pop(_OURS, 0)
        self._is_whole = _FLOOR in kept
        self._floor = kept.pop(_FLOOR, 0)
        by_age = sorted(kept, key=kept.__getitem__)
        self._floor = max([self._floor, *(kept[name] for name in by_age[:-_KEPT_MAX])])
        self._streams = {name: kept[name] for name in by_age[-_KEPT_MAX:]}
        # Streams whose stamps have shown in this run that they are of today.
        self._young: set[str] = set()
        self._asked: deque[int] = deque(maxlen=_ASKED_MAX)
        self._is_answered = False
        self.bad_count = 0
        self.unsigned_count = 0
        self.old_count = 0
        now = self._now()
        self._is_clock_behind = now < ours - _AHEAD
        self._stamp = max(ours, now)
        self._kept = self._stamp
        self._writing: threading.Thread | None = None
        self._has_kept = False
        self._write(self._values(_AHEAD))

    def _now(self) -> int:
        return _stamp_at(self._clock())

    @property
    def stamp(self) -> int:
        """Return the last stamp that was given or learnt."""
        return self._stamp

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
        stream = f"{frame[5]}/{frame[6]}/{frame[-_TAIL]}"
        if not self._is_new(stream, stamp):
            self.old_count += 1
            return False
        self._streams[stream] = stamp
        self._young.add(stream)
        self._stamp = max(self._stamp, stamp)
        if message_id == _TIMESYNC and not self._is_answered and self._answers(frame):
            self._begin_from(stream)
        return True

    def _is_new(self, stream: str, stamp: int) -> bool:
        # Only who has the key can fill the table, and more streams than these no link has.
        if stream not in self._streams and len(self._streams) >= _STREAMS_MAX:
            return False
        is_young = stream in self._young or stamp >= self._stamp - _BEHIND_MAX
        return is_young and stamp > self._streams.get(stream, self._floor)

    # ------------------------------------------------------------------- what may open, and when

    def asked(self, number: int) -> None:
        """Take a number that nobody can foresee: it was just asked to be said back."""
        self._asked.append(number)

    def _answers(self, frame: bytes) -> bool:
        """Tell whether somebody has said back a number of ours; our own question has no time."""
        payload = frame[10 : 10 + frame[1]].ljust(16, b"\0")
        time_ns, number = struct.unpack_from("<qq", payload)
        return time_ns != 0 and number in self._asked

    def _begin_from(self, stream: str) -> None:
        """Take that one stream is of now; the others have to show anew that they are of today.

        Without the stamps of before whatever was said until now may have been heard then.
        """
        self._is_answered = True
        self._young = {stream}
        if not self._is_whole:
            self._streams = {stream: self._streams[stream]}
            self._floor = self._stamp

    @property
    def is_fresh(self) -> bool:
        """Whether what is believed was said after this start: somebody answered, or nobody will.

        What the vehicle has said for so long is no repetition any more: its own stamps are later.
        """
        return self._is_answered or len(self._asked) == _ASKED_MAX

    def admit(self) -> str | None:
        """Return why an order to open is not obeyed now; None: its stamp is on disk.

        Without an answer the stamps of before have to be there, and a clock that went on. It waits
        for the disk, so nothing may be open; for one that hangs it does not wait long.
        """
        can_do_without = self.is_fresh and self._is_whole and not self._is_clock_behind
        if not (self._is_answered or can_do_without):
            return "signing: no answer yet: enable again"
        self.wait_until_kept()
        if self._begin_to_write():
            self.wait_until_kept()
            if self._has_kept:
                return None
        return "signing stamp not stored: enable again"

    # ----------------------------------------------------------------------------------- on disk

    def keep_soon(self) -> None:
        """Have the stamps written at the next turn."""
        self._kept = 0

    def keep(self, *, is_last: bool = False) -> None:
        """Write the stamps down now and then, and at the end; the control loop waits for no disk.

        The disk is waited for in a thread of its own. While a slow one still takes the stamps
        before, there are none to write.
        """
        if is_last:
            self.wait_until_kept()
            self._write(self._values(0))
        elif self._stamp >= self._kept + _KEEP_S * _PER_S:
            self._begin_to_write()

    def _values(self, ahead: int) -> dict[str, int]:
        # Until there is something to rely on, the next start shall see that there is not.
        floor = {_FLOOR: self._floor} if self._is_whole or self._is_answered else {}
        return {**self._streams, **floor, _OURS: self._stamp + ahead}

    def _begin_to_write(self) -> bool:
        if self._writing is not None and self._writing.is_alive():
            return False
        self._has_kept = False
        # A daemon: a disk that hangs does not hold up the end of the program.
        self._writing = threading.Thread(
            target=self._write, args=(self._values(_AHEAD),), name="signing", daemon=True
        )
        self._writing.start()
        self._kept = self._stamp
        return True

    def _write(self, values: dict[str, int]) -> None:
        """Replace the file; what another command (`doctor`) has learnt meanwhile stays in it."""
        if self._state is None:
            return
        try:
            found = read_state(self._state)
        except LinkError:
            found = {}
        for name, stamp in found.items():
            # What the floor covers is gone, so that the file does not grow.
            if name != _OURS and stamp > values.get(_FLOOR, 0):
                values[name] = max(values.get(name, 0), round(stamp))
        self._has_kept = write_state(self._state, values)

    def wait_until_kept(self) -> None:
        """Wait until the disk has what was written, but not for one that hangs."""
        if self._writing is not None:
            self._writing.join(_DISK_MAX_S)

    @property
    def refused_count(self) -> int:
        """Return how many sound frames were not believed."""
        return self.bad_count + self.unsigned_count + self.old_count

"""What faults do to bytes, acknowledgements and the clock, with a seeded hand."""

from __future__ import annotations

import random

from sitl.stub.faults import Fault, FaultClock, FaultKind

_WRAP_MS = 2**32

# The start bytes of MAVLink 2 and 1, so that garbage looks like frames that begin.
_STARTS = b"\xfd\xfe"
_UNKNOWN_IDS = (60_000, 2**24)


class Impairment:
    """Damages what the autopilot sends, as far as a fault is in force."""

    def __init__(self, faults: FaultClock, *, seed: int) -> None:
        self._faults = faults
        # Not for secrets: the same seed must give the same damage.
        self._random = random.Random(seed)

    def strikes(self, kind: FaultKind, now_s: float, *, command: int = 0) -> Fault | None:
        """Return the fault of a kind that is in force and strikes this time."""
        fault = self._faults.active(kind, now_s, command=command)
        if fault is None or self._random.random() >= fault.fraction:
            return None
        return fault

    def apply(self, frame: bytes, now_s: float) -> bytes:
        """Return what goes out in place of a frame; nothing while the link is silent."""
        if self._faults.active(FaultKind.SILENCE, now_s):
            return b""
        if self.strikes(FaultKind.CORRUPT, now_s):
            place = self._random.randrange(len(frame))
            changed = frame[place] ^ self._random.randrange(1, 256)
            frame = frame[:place] + bytes((changed,)) + frame[place + 1 :]
        if self.strikes(FaultKind.TRUNCATED, now_s):
            frame = frame[: self._random.randrange(1, len(frame))]
        if self.strikes(FaultKind.UNKNOWN_ID, now_s):
            frame = self._unknown() + frame
        if self.strikes(FaultKind.GARBAGE, now_s):
            burst = bytearray(self._random.randbytes(self._random.randrange(1, 280)))
            burst[self._random.randrange(len(burst))] = self._random.choice(_STARTS)
            frame = bytes(burst) + frame
        return frame

    def clock_s(self, uptime_s: float, now_s: float) -> float:
        """Return the time since boot, about to wrap or set back by a fault; TIMESYNC tells it."""
        wrap = self._faults.active(FaultKind.CLOCK_WRAP, now_s)
        if wrap is not None:
            uptime_s = _WRAP_MS / 1000.0 + self._faults.elapsed_s(wrap, now_s) - wrap.delay_s
        back = self._faults.active(FaultKind.CLOCK_BACKWARDS, now_s)
        return uptime_s if back is None else max(uptime_s - back.delay_s, 0.0)

    def boot_ms(self, uptime_s: float, now_s: float) -> int:
        """Return the 32 bits of milliseconds since boot that messages have."""
        return round(self.clock_s(uptime_s, now_s) * 1000.0) % _WRAP_MS

    def _unknown(self) -> bytes:
        """Return a frame with an id that no dialect has; nobody can check it."""
        payload = self._random.randbytes(self._random.randrange(1, 60))
        identifier = self._random.randrange(_UNKNOWN_IDS[0], _UNKNOWN_IDS[1]).to_bytes(3, "little")
        head = bytes((_STARTS[0], len(payload), 0, 0, self._random.randrange(256), 1, 1))
        return head + identifier + payload + self._random.randbytes(2)

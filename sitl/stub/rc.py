"""The pilot's transmitter: sticks in the middle, switches low, unless a fault moves them."""

from __future__ import annotations

from sitl.stub.faults import FaultClock, FaultKind

RC_COUNT = 16
_STICKS = 4
_MIDDLE_US, _LOW_US = 1500, 1000


def rc_pulses_us(faults: FaultClock, now_s: float) -> tuple[int, ...]:
    """Return the position of each control."""
    pulses = [_MIDDLE_US] * _STICKS + [_LOW_US] * (RC_COUNT - _STICKS)
    for fault in faults.every(FaultKind.RC, now_s):
        if fault.channel <= RC_COUNT:
            pulses[fault.channel - 1] = fault.pulse_us
    return tuple(pulses)

"""Faults of a scenario on the inputs of a flight without sockets.

The same scenario file as for the stub autopilot; here the faults that a message can carry act on
the messages as they are decoded. Faults of the wire itself need a wire and are refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    SpeedReport,
    Telemetry,
)
from companion.errors import ConfigError
from sitl.stub.faults import Fault, FaultClock, FaultKind
from sitl.stub.modes import MODE_NAMES

# The largest latitude and longitude that GLOBAL_POSITION_INT can hold.
EXTREME_DEG = 0x7FFFFFFF * 1e-7
ON_INPUTS = frozenset(
    {
        FaultKind.NO_POSITION,
        FaultKind.STALE_POSITION,
        FaultKind.ZERO_POSITION,
        FaultKind.EXTREME_POSITION,
        FaultKind.HEADING_UNKNOWN,
        FaultKind.GPS_DROP,
        FaultKind.CLOCK_BACKWARDS,
        FaultKind.SILENCE,
        FaultKind.MODE,
    }
)


def check_on_inputs(faults: tuple[Fault, ...], path: Path) -> None:
    """Refuse a scenario with faults that only a wire can have."""
    for fault in faults:
        if fault.kind not in ON_INPUTS:
            raise ConfigError(
                f"{path}: kind = '{fault.kind}' needs a wire; use `vrspray sitl serve`, or one of "
                + ", ".join(sorted(ON_INPUTS))
            )


def with_faults(
    items: Iterable[Input], faults: tuple[Fault, ...], *, start_s: float
) -> Iterator[Input]:
    """Yield the inputs as they arrive under `faults`; the flight begins at its take-off."""
    clock = FaultClock(faults, start_s=start_s)
    clock.take_off_s = start_s
    state = _State(clock)
    for item in items:
        arrived = state.pass_on(item)
        if arrived is not None:
            yield arrived


@dataclass(slots=True)
class _State:
    """The faults, and the last position that was a true one."""

    clock: FaultClock
    last: Telemetry | None = None

    def pass_on(self, item: Input) -> Input | None:
        """Return one input as it arrives; None for one that does not."""
        now_s = item.received_s
        if self.clock.active(FaultKind.SILENCE, now_s):
            return None
        if isinstance(item, Telemetry):
            return self._position(item)
        return self._report(item)

    def _report(self, item: Input) -> Input:
        """Return what is no position, as the fault has it."""
        now_s = item.received_s
        stale = self.clock.active(FaultKind.STALE_POSITION, now_s) is not None
        drop = self.clock.active(FaultKind.GPS_DROP, now_s)
        mode = self.clock.active(FaultKind.MODE, now_s)
        if stale and isinstance(item, SpeedReport):
            return replace(item, ground_speed_m_s=0.0)
        if stale and isinstance(item, EstimatorReport):
            return replace(item, healthy=False)
        if drop is not None and isinstance(item, GnssReport):
            return replace(item, fix=Fix(min(max(drop.fix, 0), 6)))
        if mode is not None and isinstance(item, HeartbeatReport):
            return replace(item, mode=MODE_NAMES.get(mode.mode, f"MODE_{mode.mode}"))
        return item

    def _position(self, item: Telemetry) -> Telemetry | None:
        now_s, active = item.received_s, self.clock.active
        if active(FaultKind.NO_POSITION, now_s):
            return None
        if active(FaultKind.STALE_POSITION, now_s):
            if self.last is None:
                return None
            return replace(
                self.last,
                received_s=now_s,
                boot_s=item.boot_s,
                velocity_north_m_s=0.0,
                velocity_east_m_s=0.0,
                velocity_down_m_s=0.0,
            )
        self.last = item
        if active(FaultKind.ZERO_POSITION, now_s):
            item = replace(item, latitude_deg=0.0, longitude_deg=0.0)
        if active(FaultKind.EXTREME_POSITION, now_s):
            item = replace(item, latitude_deg=EXTREME_DEG, longitude_deg=EXTREME_DEG)
        if active(FaultKind.HEADING_UNKNOWN, now_s):
            item = replace(item, heading_deg=None)
        back = active(FaultKind.CLOCK_BACKWARDS, now_s)
        return item if back is None else replace(item, boot_s=item.boot_s - back.delay_s)

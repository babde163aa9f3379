"""The truth of one flight, as every metric takes it.

The twin knows it; a flight with hardware gives it as far as meter and receiver see it. Nothing
here says where it came from, and nothing here was seen by the controller.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, overload

import numpy as np
from numpy.typing import NDArray

from companion.core.boom import Boom, Valve
from companion.core.types import TimedChange

if TYPE_CHECKING:
    from companion.core.nozzle import NozzleSet
    from companion.core.options.coverage import Coverage
    from companion.core.options.lines import Lines
    from companion.core.options.overlap import OverlapGuard
    from companion.core.prescription import Prescription

# Spans of time: (from, until) in seconds.

Spans = tuple[tuple[float, float], ...]


def joined(spans: Iterable[tuple[float, float]]) -> Spans:
    """Return the spans in order and apart.

    >>> joined([(5.0, 6.0), (1.0, 2.0), (2.0, 3.0)])
    ((1.0, 3.0), (5.0, 6.0))
    """
    found: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans):
        if found and begin_s <= found[-1][1]:
            found[-1] = (found[-1][0], max(found[-1][1], end_s))
        else:
            found.append((begin_s, end_s))
    return tuple(found)


Floats = NDArray[np.float64]
Fidelity = Literal["averaged", "pulsed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightMeta:
    """What was flown, for the rows of tables; no metric depends on it.

    `training` is the mark of the flight's journal: `water` or `dry` where no product was sprayed,
    `no` where one was, None where nobody says.
    """

    speed_m_s: float
    method: str
    fidelity: Fidelity
    output: str
    seed: int
    training: str | None = None


class Orders(Sequence[TimedChange]):
    """Changes of duty in order of time, in arrays; each is made when it is asked for.

    A flight has ten thousand: most that is asked of them is asked of all at once.
    """

    def __init__(self, at_s: Floats, valve: NDArray[np.int64], duty: Floats) -> None:
        if not (((duty >= 0.0) & (duty <= 1.0)).all() and (np.abs(at_s) < np.inf).all()):
            raise ValueError("a change has a duty outside [0, 1], or a time that is not finite")
        if not (valve >= 0).all():
            raise ValueError("a change has a negative valve index")
        self.at_s, self.valve, self.duty = at_s, valve, duty

    @classmethod
    def of(cls, changes: Sequence[TimedChange]) -> Orders:
        """Return changes in arrays."""
        if isinstance(changes, Orders):
            return changes
        return cls(
            np.array([each.at_s for each in changes], dtype=np.float64),
            np.array([each.valve for each in changes], dtype=np.int64),
            np.array([each.duty for each in changes], dtype=np.float64),
        )

    def of_valve(self, valve: int) -> Orders:
        """Return those of one valve."""
        its = np.flatnonzero(self.valve == valve)
        return Orders(self.at_s[its], self.valve[its], self.duty[its])

    def __len__(self) -> int:
        return len(self.at_s)

    @overload
    def __getitem__(self, index: int) -> TimedChange: ...
    @overload
    def __getitem__(self, index: slice) -> Orders: ...
    def __getitem__(self, index: int | slice) -> TimedChange | Orders:
        if isinstance(index, slice):
            return Orders(self.at_s[index], self.valve[index], self.duty[index])
        return TimedChange(
            at_s=self.at_s.item(index), valve=self.valve.item(index), duty=self.duty.item(index)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRecord:
    """True path and true volume at even steps of time (2 ms pulsed, 10 ms averaged).

    The path is that of the autopilot's position reference; the strips hang on it by the boom's
    offsets. `volume_ml` is cumulative, one column a valve. `orders` are the changes of duty as
    executed at the output, in order of time; they may be empty. `duty_limits` are the lowest and
    the highest duty of the PWM: a valve held there and still beside its dose is saturated.
    `nozzle_sets` are those that the controller took its duties from: they tell what flow an order
    asked for; none where that is not known. With `lines` only they were to be sprayed, with
    a `guard` no ground twice, nor what was `treated` by flights before. `unknown`
    has each valve's times, in order and apart, of which nobody can tell what was sprayed; it is
    empty where all is known. `ferried` is when nothing was asked for, and nothing held the valves.
    `position_sd_m` is how far the positions that were told wander along one axis (1 sd), 0 where
    nobody knows.
    """

    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_deg: Floats
    volume_ml: Floats
    boom: Boom
    prescription: Prescription
    pwm_period_s: float
    orders: Sequence[TimedChange]
    meta: FlightMeta
    duty_limits: tuple[float, float] = (0.0, 1.0)
    nozzle_sets: tuple[NozzleSet, ...] = ()
    lines: Lines | None = None
    guard: OverlapGuard | None = None
    treated: Coverage | None = None
    unknown: tuple[Spans, ...] = ()
    ferried: Spans = ()
    position_sd_m: float = 0.0

    def __post_init__(self) -> None:
        samples = len(self.time_s)
        if samples < 3:
            raise ValueError(f"a flight record needs at least three samples, got {samples}")
        for name in ("east_m", "north_m", "heading_deg"):
            if getattr(self, name).shape != (samples,):
                raise ValueError(f"{name} must have {samples} values")
        if self.volume_ml.shape != (samples, len(self.boom.valves)):
            raise ValueError(f"volume_ml must be samples x valves, got {self.volume_ml.shape}")
        steps_s = np.diff(self.time_s)
        if not (steps_s[0] > 0.0 and np.abs(steps_s - steps_s.mean()).max() < 1e-3 * steps_s[0]):
            raise ValueError("time_s must rise in even steps")
        if not self.pwm_period_s > 0.0:
            raise ValueError(f"pwm_period_s must be positive, got {self.pwm_period_s}")
        if not all(np.isfinite(a).all() for a in (self.east_m, self.north_m, self.volume_ml)):
            raise ValueError("positions and volumes must be finite")
        if not np.diff(self.volume_ml, axis=0).min() >= -1e-6:
            raise ValueError("volume_ml is cumulative: it must not fall")

    @property
    def step_s(self) -> float:
        """Return the spacing of the samples."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)


def whole_boom(record: FlightRecord) -> FlightRecord:
    """Return the same flight with the boom as one strip and the total flow as its flow.

    P1 judged its sprayer so, and a flight that changes between nozzle sets must be judged so:
    there the share of one valve says nothing. The orders stay those of the single valves.
    """
    valves = record.boom.valves
    widths_m = np.array([valve.width_m for valve in valves])
    share = widths_m / widths_m.sum()
    one = Valve(
        name="boom",
        right_m=float(share @ [valve.right_m for valve in valves]),
        forward_m=float(share @ [valve.forward_m for valve in valves]),
        width_m=float(widths_m.sum()),
    )
    return replace(
        record,
        boom=replace(record.boom, valves=(one,)),
        volume_ml=record.volume_ml.sum(axis=1, keepdims=True),
    )

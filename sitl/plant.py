"""The flow truth: cumulative volume of each valve, exact in the recorded orders, and its meter.

The plant's own `meter_volume_ml` answers for any time and goes over all of the past to do so;
this one goes forward only, so that a meter that reports often costs little.

An order becomes a step of a valve's flow after its dead time, spread into a ramp by the hose. The
sum of ramps is integrated in closed form, so volume is conserved to rounding, whatever the times
at which it is asked for.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from sitl.profile import Parts, draw_scatter, flow_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sitl.profile import PlantProfile

# ---------------------------------------------------------------------------------------- the meter

# Flows below this are what is left of sums that should be zero [mL/s]; slopes likewise [mL/s2].
ROUNDING = 1e-9
# How many periods' noise is asked for at once.
BLOCK = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class Metering:
    """One meter: when it began to count, its noise's period, its delay, pulses per millilitre.

    `factors` gives reading over truth of the first so many periods.
    """

    start_s: float
    period_s: float
    lag_s: float
    per_ml: float
    factors: Callable[[int], list[float]]


class MeterStream:
    """Counts what all valves together deliver, up to times that do not go back."""

    def __init__(self, metering: Metering) -> None:
        self._start_s, self._period_s = metering.start_s, metering.period_s
        self._lag_s, self._per_ml = metering.lag_s, metering.per_ml
        self._all_factors = metering.factors
        self._factors: list[float] = metering.factors(BLOCK)
        self._bends: list[tuple[float, float]] = []
        self._at_s = metering.start_s
        self._flow_ml_s = 0.0
        self._slope_ml_s2 = 0.0
        self._index = 0
        self._edge_s = metering.start_s + metering.period_s
        self._whole_ml = 0.0  # metered, all whole periods so far
        self._part_ml = 0.0  # true, of the period in progress

    def step(self, at_s: float, change_ml_s: float, ramp_s: float) -> None:
        """Let the flow begin to change at `at_s`, which was not counted yet, within `ramp_s`."""
        slope_ml_s2 = change_ml_s / ramp_s
        heapq.heappush(self._bends, (at_s, slope_ml_s2))
        heapq.heappush(self._bends, (at_s + ramp_s, -slope_ml_s2))

    def count(self, time_s: float) -> int:
        """Return the pulses up to `time_s`; the meter sees the flow its own delay later."""
        seen_s = time_s - self._lag_s
        while self._edge_s <= seen_s:
            self._run(self._edge_s)
            self._whole_ml += self._part_ml * self._factor()
            self._part_ml = 0.0
            self._index += 1
            self._edge_s = self._start_s + self._period_s * (self._index + 1)
        self._run(seen_s)
        volume_ml = self._whole_ml + self._part_ml * self._factor()
        return math.floor(volume_ml * self._per_ml + ROUNDING)

    def _factor(self) -> float:
        if self._index >= len(self._factors):
            self._factors = self._all_factors(len(self._factors) + BLOCK)
        return self._factors[self._index]

    def _run(self, until_s: float) -> None:
        bends = self._bends
        while bends and bends[0][0] <= until_s:
            at_s, slope_ml_s2 = heapq.heappop(bends)
            self._go(at_s)
            self._slope_ml_s2 += slope_ml_s2
            if abs(self._slope_ml_s2) < ROUNDING:
                self._slope_ml_s2 = 0.0
                if abs(self._flow_ml_s) < ROUNDING:
                    self._flow_ml_s = 0.0
        self._go(until_s)

    def _go(self, until_s: float) -> None:
        step_s = until_s - self._at_s
        if step_s > 0.0:
            self._part_ml += step_s * (self._flow_ml_s + 0.5 * self._slope_ml_s2 * step_s)
            self._flow_ml_s += self._slope_ml_s2 * step_s
            self._at_s = until_s


class _Volume(Protocol):
    """A flow that knows its volume at any one time."""

    def volume_at(self, time_s: float) -> float:
        """Return the cumulative volume."""


class VolumeMeter(MeterStream):
    """The meter of a flow that is no chain of ramps: a pump's."""

    def __init__(self, flow: _Volume, metering: Metering) -> None:
        super().__init__(metering)
        self._flow = flow
        self._seen_ml = 0.0

    def _run(self, until_s: float) -> None:
        volume_ml = self._flow.volume_at(until_s)
        self._part_ml += volume_ml - self._seen_ml
        self._seen_ml = volume_ml


# What reaches a valve: electrical edges, from whatever makes them.


class Edge(Protocol):
    """One valve is to be open or closed from `at_s`; `duty` is the one in force.

    An edge that repeats the state of its valve tells of a new duty: an open valve that stays open,
    or one that rests in its gap and is now closed for good (`duty` 0).
    """

    @property
    def at_s(self) -> float: ...  # noqa: D102
    @property
    def valve(self) -> int: ...  # noqa: D102
    @property
    def is_open(self) -> bool: ...  # noqa: D102
    @property
    def duty(self) -> float: ...  # noqa: D102


class BoardEdge(NamedTuple):
    """An edge that the driver board makes."""

    at_s: float
    valve: int
    is_open: bool
    duty: float


# ---------------------------------------------------------------------------------------- the plant

Floats = NDArray[np.float64]


class Flow(Protocol):
    """The flow of one outlet, integrated."""

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return the cumulative volume at times that were not forgotten."""

    def forget(self, before_s: float) -> None:
        """Drop what is only needed for times before `before_s`."""


class Ramps:
    """The flow of one valve: steps, each spread over a ramp, and their integral."""

    def __init__(self, start_s: float) -> None:
        # Each step: when it begins, the change of flow, the length of its ramp.
        self._steps: list[tuple[float, float, float]] = []
        self._from_s = start_s
        self._from_ml = 0.0
        self._from_ml_s = 0.0
        self._knots: tuple[Floats, Floats, Floats, Floats] | None = None

    def step(self, at_s: float, change_ml_s: float, ramp_s: float) -> None:
        """Let the flow begin to change by `change_ml_s` at `at_s`, within `ramp_s`."""
        self._steps.append((at_s, change_ml_s, ramp_s))
        self._knots = None

    @property
    def steps(self) -> tuple[tuple[float, float, float], ...]:
        """Return the steps that were not forgotten."""
        return tuple(self._steps)

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return the cumulative volume at times that were not forgotten."""
        volume_ml = self._from_ml + self._from_ml_s * (times_s - self._from_s)
        if not self._steps:
            return volume_ml
        if self._knots is None:
            self._knots = self._build()
        at_s, slope, flow_ml_s, knot_ml = self._knots
        i = np.searchsorted(at_s, times_s, side="right") - 1
        since_s = np.where(i >= 0, times_s - at_s[i], 0.0)
        more_ml = knot_ml[i] + since_s * (flow_ml_s[i] + 0.5 * slope[i] * since_s)
        result: Floats = volume_ml + np.where(i >= 0, more_ml, 0.0)
        return result

    def lines(self) -> tuple[Floats, Floats, Floats]:
        """Return since when the flow is which line: time, flow [mL/s], slope; from long ago on."""
        if self._knots is None and self._steps:
            self._knots = self._build()
        base, flat = np.array([self._from_ml_s]), np.zeros(1)
        if self._knots is None:
            return np.array([self._from_s]), base, flat
        at_s, slope, flow_ml_s, _ = self._knots
        first_s = np.minimum(self._from_s, at_s[:1]) - 1.0
        return (
            np.concatenate((first_s, at_s)),
            np.concatenate((base, base + flow_ml_s)),
            np.concatenate((flat, slope)),
        )

    def _build(self) -> tuple[Floats, Floats, Floats, Floats]:
        steps = np.array(self._steps)
        at_s = np.concatenate((steps[:, 0], steps[:, 0] + steps[:, 2]))
        slopes = steps[:, 1] / steps[:, 2]
        bend = np.concatenate((slopes, -slopes))
        order = np.argsort(at_s, kind="stable")
        at_s, slope = at_s[order], np.cumsum(bend[order])
        slope[np.abs(slope) < ROUNDING] = 0.0
        gap_s = np.diff(at_s)
        flow_ml_s = np.concatenate(([0.0], np.cumsum(slope[:-1] * gap_s)))
        flow_ml_s[np.abs(flow_ml_s) < ROUNDING] = 0.0
        gap_ml = gap_s * (flow_ml_s[:-1] + 0.5 * slope[:-1] * gap_s)
        return at_s, slope, flow_ml_s, np.concatenate(([0.0], np.cumsum(gap_ml)))

    def forget(self, before_s: float) -> None:
        """Fold all steps that are complete before `before_s` into one straight line."""
        self._from_ml += self._from_ml_s * (before_s - self._from_s)
        self._from_s = before_s
        kept = []
        for at_s, change_ml_s, ramp_s in self._steps:
            if at_s + ramp_s <= before_s:
                self._from_ml += change_ml_s * (before_s - at_s - 0.5 * ramp_s)
                self._from_ml_s += change_ml_s
            else:
                kept.append((at_s, change_ml_s, ramp_s))
        self._steps = kept
        self._knots = None


class Plant:
    """What both fidelities share: which valves are in use, scatter, volumes, meter."""

    def __init__(
        self,
        profile: PlantProfile,
        *,
        seed: int,
        start_s: float = 0.0,
    ) -> None:
        self.profile = profile
        self._check_kind()
        rng = np.random.default_rng(seed)
        self._scatter = draw_scatter(profile, rng)
        self._table = flow_table(profile)
        count = profile.valve_count
        self._ramps = [Ramps(start_s) for _ in range(count)]
        self._flows: Sequence[Flow] = self._ramps
        self._level_ml_s = [0.0] * count
        self._duty = [0.0] * count
        self._is_open = [False] * count
        self._opened_s = [-math.inf] * count
        self._late_s = [0.0] * count
        self._active = 0
        # What goes wrong in flight (`liquid_faults.py`): valves that stick, openings, the supply.
        self._stuck: set[int] = set()
        self._ordered = [0.0] * count
        self._opening = [1.0] * count
        self._supply = 1.0
        self._leak_ml_s = 0.0
        self._leak = Ramps(start_s)
        self._start_s = self._forgotten_s = start_s
        spread = profile.meter.gain_spread
        self._meter = _MeterState(
            gain=1.0 + float(rng.uniform(-spread, spread)), noise_rng=rng.spawn(1)[0]
        )
        self._stream: MeterStream | None = None
        what = profile.imperfections
        self._parts = None if what is None else Parts(what, count, seed=seed, start_s=start_s)

    def _check_kind(self) -> None:
        """Refuse a sprayer whose flow is not made by its valves."""
        if self.profile.pump is not None:
            raise ConfigError(
                f"the sprayer {self.profile.name} has a pump that makes the flow and no PWM "
                "valves; fly it with `vrspray sitl fly`"
            )

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return (n, valves): what each valve has delivered up to each time."""
        times_s = np.asarray(times_s, dtype=np.float64)
        if len(times_s) and not times_s.min() >= self._forgotten_s - 1e-9:
            raise ValueError(f"{times_s.min()} s was forgotten or lies before the start")
        return np.column_stack([flow.volume_ml(times_s) for flow in self._flows])

    def meter_volume_ml(self, times_s: Floats) -> Floats:
        """Return what the flow meter has counted up to each time, before rounding to pulses."""
        state, period_s = self._meter, self.profile.pwm.period_s
        seen_s = np.maximum(
            np.asarray(times_s, dtype=np.float64) - self.profile.meter.lag_s, self._meter_from_s()
        )
        periods = np.floor((seen_s - self._start_s) / period_s).astype(np.int64)
        last = int(periods.max(initial=state.index))
        edges_s: Floats = self._start_s + period_s * np.arange(state.index, last + 2, dtype=float)
        factors = state.factors(last + 1, self.profile.meter.noise)[state.index :]
        true_ml = self._metered_ml(edges_s)
        edge_ml = state.volume_ml + np.concatenate(([0.0], np.cumsum(np.diff(true_ml) * factors)))
        i = periods - state.index
        result: Floats = edge_ml[i] + factors[i] * (self._metered_ml(seen_s) - true_ml[i])
        return result

    def _metered_ml(self, times_s: Floats) -> Floats:
        """Return what has passed the meter: all valves, and a leak behind it."""
        through_ml: Floats = self.volume_ml(times_s).sum(axis=1)
        return through_ml + self._leak.volume_ml(times_s) if self._leak.steps else through_ml

    def meter_count(self, times_s: Floats) -> NDArray[np.int64]:
        """Return the meter's pulses up to each time."""
        per_ml = self.profile.meter.pulses_per_l / 1000.0
        return np.floor(self.meter_volume_ml(times_s) * per_ml + ROUNDING).astype(np.int64)

    def meter_counter(self) -> Callable[[float], int]:
        """Return the meter to be read in passing: the same counts, in order of time only."""
        if self._flows is not self._ramps:
            return lambda time_s: int(self.meter_count(np.array([time_s]))[0])
        stream = self._stream = MeterStream(self._metering())
        for ramps in self._ramps:
            for step in ramps.steps:
                stream.step(*step)
        return stream.count

    def _metering(self) -> Metering:
        meter, state = self.profile.meter, self._meter
        return Metering(
            start_s=self._start_s,
            period_s=self.profile.pwm.period_s,
            lag_s=meter.lag_s,
            per_ml=meter.pulses_per_l / 1000.0,
            factors=lambda count: state.factors(count, meter.noise).tolist(),
        )

    def _meter_from_s(self) -> float:
        return self._start_s + self._meter.index * self.profile.pwm.period_s

    def forget(self, before_s: float) -> None:
        """Drop what is only needed for times before `before_s`: for flights in real time."""
        period_s = self.profile.pwm.period_s
        index = math.floor((before_s - self._start_s) / period_s)
        if index <= self._meter.index:
            return
        edge_s = self._start_s + index * period_s
        at_s = np.array([edge_s + self.profile.meter.lag_s])
        self._meter.volume_ml = float(self.meter_volume_ml(at_s)[0])
        self._meter.index = index
        self._forgotten_s = edge_s
        for flow in self._flows:
            flow.forget(edge_s)

    def _take(self, at_s: float, valve: int, *, duty: float, is_open: bool) -> None:
        """Bring one valve to its new state, and all others to the pressure that it leaves."""
        was_active = self._duty[valve] > 0.0
        is_edge = is_open != self._is_open[valve]
        self._duty[valve], self._is_open[valve] = duty, is_open
        if self._parts is not None and is_edge:
            late_s = self._parts.late_s(valve, at_s, self._is_open, is_open=is_open)
            self._late_s[valve] = late_s
        moves = self._parts is not None and self._parts.moves_others
        if (duty > 0.0) != was_active or moves:
            self._active += (duty > 0.0) - was_active
            for other, is_other_open in enumerate(self._is_open):
                if is_other_open and other != valve:
                    self._set_level(at_s, other)
        self._set_level(at_s, valve)

    def _set_level(self, at_s: float, valve: int) -> None:
        is_open = self._is_open[valve]
        level_ml_s = 0.0
        if is_open:
            level_ml_s = self._flow_ml_s(self._duty[valve]) * self._scale(valve, at_s)
        change_ml_s = level_ml_s - self._level_ml_s[valve]
        if change_ml_s != 0.0:
            self._level_ml_s[valve] = level_ml_s
            dead_s = self._dead_s(is_open=is_open) + self._scatter.shift_s[valve]
            dead_s += self._late_s[valve]
            begin_s, ramp_s = at_s + max(dead_s, 0.0), self._ramp_s(is_open=is_open)
            if is_open:
                self._opened_s[valve] = begin_s + ramp_s
            else:
                # A pulse cut short goes back from where it has come to: no flow falls below zero.
                ramp_s = max(ramp_s, self._opened_s[valve] - begin_s)
            step = (begin_s, change_ml_s, ramp_s)
            self._ramps[valve].step(*step)
            if self._stream is not None:
                self._stream.step(*step)

    def _scale(self, valve: int, at_s: float) -> float:
        scale = self._scatter.flow_scale[valve] * self._opening[valve] * self._supply
        if self._parts is None:
            return scale
        return scale * self._parts.scale(valve, at_s, self._duty, self._is_open)

    def stick(self, at_s: float, valve: int, *, is_open: bool) -> None:
        """Let a valve stay as it is told here, whatever it is ordered from now on."""
        self._stuck.add(valve)
        self._take(at_s, valve, duty=1.0 if is_open else 0.0, is_open=is_open)

    def restrict(self, at_s: float, *, openings: Sequence[float], supply: float) -> None:
        """Let each valve's nozzles pass a share of their flow, and the supply give one of all."""
        self._opening, self._supply = list(openings), supply
        for valve, is_open in enumerate(self._is_open):
            if is_open:
                self._set_level(at_s, valve)
        self.leak(at_s, self._leak_ml_s)

    def leak(self, at_s: float, flow_ml_s: float) -> None:
        """Let so much flow leave the line behind the meter, and through no nozzle."""
        steps = self._leak.steps
        change_ml_s = flow_ml_s * self._supply - sum(step[1] for step in steps)
        self._leak_ml_s = flow_ml_s
        if change_ml_s != 0.0:
            step = (at_s, change_ml_s, self.profile.ramp_s)
            self._leak.step(*step)
            if self._stream is not None:
                self._stream.step(*step)

    def flow_and_order(self) -> tuple[float, float, float]:
        """Return mean flow over ordered flow but for the supply, the supply, and the mean duty.

        All are as ordered now: what is on its way is taken as arrived. The flow is 1 where
        nothing is ordered.
        """
        ordered = [duty for duty in self._ordered if duty > 0.0]
        if not ordered:
            return 1.0, self._supply, 0.0
        nominal_ml_s = sum(self._table.mean_ml_s(duty, len(ordered)) for duty in ordered)
        flow_ml_s = self._leak_ml_s + sum(
            self._table.mean_ml_s(duty, self._active) * self._opening[valve]
            for valve, duty in enumerate(self._duty)
            if duty > 0.0
        )
        return flow_ml_s / nominal_ml_s, self._supply, sum(ordered) / len(ordered)

    def _flow_ml_s(self, duty: float) -> float:
        raise NotImplementedError

    def _ramp_s(self, *, is_open: bool) -> float:
        raise NotImplementedError

    def _dead_s(self, *, is_open: bool) -> float:
        raise NotImplementedError

    def _follows(self, valve: int) -> bool:
        return valve not in self._stuck


class PulsedPlant(Plant):
    """Every pulse as it is: fed with the edges that reach the valves, in order of time."""

    def record(self, edges: Iterable[Edge]) -> None:
        """Take down edges."""
        for edge in edges:
            self._ordered[edge.valve] = edge.duty
            if self._follows(edge.valve):
                self._take(edge.at_s, edge.valve, duty=edge.duty, is_open=edge.is_open)

    def _flow_ml_s(self, duty: float) -> float:
        return self._table.open_ml_s(duty, self._active)

    def _dead_s(self, *, is_open: bool) -> float:
        return self.profile.dead_open_s if is_open else self.profile.dead_close_s

    def _ramp_s(self, *, is_open: bool) -> float:
        return self.profile.ramp_s if is_open else self.profile.closing_s


class AveragedPlant(Plant):
    """The mean of the pulses, with the same volume-equivalent lags: fed with changes of duty."""

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down that `valve` has `duty` from `at_s` on."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {duty}")
        self._ordered[valve] = duty
        if self._follows(valve) and duty != self._duty[valve]:
            self._take(at_s, valve, duty=duty, is_open=duty > 0.0)

    def _flow_ml_s(self, duty: float) -> float:
        return self._table.mean_ml_s(duty, self._active)

    def _dead_s(self, *, is_open: bool) -> float:  # noqa: ARG002 - the middle of a pulse has one lag
        return self.profile.mean_lag_s - 0.5 * self.profile.closing_s

    def _ramp_s(self, *, is_open: bool) -> float:  # noqa: ARG002 - likewise; the shorter of the two
        return self.profile.closing_s


class _MeterState:
    """The meter's gain and noise, and what it had counted when the past was forgotten."""

    def __init__(self, *, gain: float, noise_rng: np.random.Generator) -> None:
        self.gain = gain
        self.index = 0
        self.volume_ml = 0.0
        self._rng = noise_rng
        self._noise: Floats = np.zeros(0)

    def factors(self, count: int, noise: float) -> Floats:
        """Return reading over truth of the first `count` PWM periods, the same at every call."""
        if len(self._noise) < count:
            more = self._rng.standard_normal(max(count - len(self._noise), 256))
            self._noise = np.concatenate((self._noise, more))
        return self.gain * (1.0 + noise * self._noise[:count])

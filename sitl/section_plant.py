"""A pump that makes the flow, and on-off valves that divide it among sections of the boom."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sitl.plant import Floats, MeterStream, Plant, VolumeMeter
from sitl.profile import ML_S_PER_L_MIN, flow_table
from sitl.supply import Supply

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sitl.plant import Edge
    from sitl.profile import PlantProfile


class SectionPlant(Plant):
    """Takes changes of duty or edges (above 0 is open), and orders of the pump.

    There are no pulses, so that both fidelities are the same.
    """

    def __init__(
        self,
        profile: PlantProfile,
        *,
        seed: int,
        start_s: float = 0.0,
    ) -> None:
        supply = profile.supply
        if supply is None or supply.control != "modulates":
            raise ValueError(f"the sprayer {profile.name} has no pump that feeds sections")
        super().__init__(profile, seed=seed, start_s=start_s)
        self._pump: Supply = supply
        self._pump_ml_s = flow_table(profile)
        scales = np.array(self._scatter.flow_scale)
        self._flow = SectionFlow(
            (scales / scales.sum()).tolist(),
            up_s=supply.up_s,
            down_s=supply.down_s,
            most_ml_s=supply.relief * profile.nozzle_sets[-1].flow_max_l_min * ML_S_PER_L_MIN,
            start_s=start_s,
            is_open=not supply.valves,
        )
        self._flows = (_Whole(self._flow),)
        self._heard_s = start_s
        self._fraction = 0.0
        # When each valve began to move last, and when it stands: none overtakes itself.
        self._began_s = [start_s] * profile.valve_count
        self._stands_s = [start_s] * profile.valve_count

    def _check_kind(self) -> None:
        """Refuse nothing more: the constructor has seen that there is a pump."""

    @property
    def flow(self) -> SectionFlow:
        """Return the flow itself: what the pump has given, too."""
        return self._flow

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on."""
        fraction = self._pump.fraction(pulse_us)
        if fraction == self._fraction:
            return
        dead_s = self._pump.spin_up_s if self._fraction == 0.0 else self._pump.dead_s
        self._fraction = fraction
        self._heard_s = max(at_s + dead_s, self._heard_s)
        count = self.profile.valve_count
        self._flow.pump(self._heard_s, count * self._pump_ml_s.mean_ml_s(fraction, count))

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down that a valve is ordered to be open (above 0) or shut from `at_s` on."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {duty}")
        is_open = duty > 0.0
        self._duty[valve] = duty
        if is_open == self._is_open[valve] or not self._pump.valves:
            return
        self._is_open[valve] = is_open
        profile = self.profile
        dead_s = profile.dead_open_s if is_open else profile.dead_close_s
        ramp_s = profile.ramp_s if is_open else profile.closing_s
        begin_s = at_s + max(dead_s + self._scatter.shift_s[valve], 0.0)
        begin_s = max(begin_s, self._began_s[valve])
        # A valve that is still moving turns round from where it has come to.
        end_s = max(begin_s + ramp_s, self._stands_s[valve])
        self._began_s[valve], self._stands_s[valve] = begin_s, end_s
        self._flow.ramp(valve, begin_s, end_s - begin_s, is_open=is_open)

    def record(self, edges: Iterable[Edge]) -> None:
        """Take down edges."""
        for edge in edges:
            self.record_change(edge.at_s, edge.valve, 1.0 if edge.is_open else 0.0)

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return (n, valves): what each section has delivered up to each time."""
        times_s = np.asarray(times_s, dtype=np.float64)
        if len(times_s) and not times_s.min() >= self._forgotten_s - 1e-9:
            raise ValueError(f"{times_s.min()} s was forgotten or lies before the start")
        return self._flow.volumes_ml(times_s)

    def meter_counter(self) -> Callable[[float], int]:
        """Return the meter to be read in passing."""
        return self.meter_stream().count

    def meter_stream(self) -> MeterStream:
        """Return the meter before the sections, behind the way back to the tank."""
        return VolumeMeter(self._flow, self._metering())


class _Whole:
    """All sections together, as the base class keeps flows."""

    def __init__(self, flow: SectionFlow) -> None:
        self._flow = flow

    def volume_ml(self, times_s: Floats) -> Floats:
        result: Floats = self._flow.volumes_ml(times_s).sum(axis=1)
        return result

    def forget(self, before_s: float) -> None:
        self._flow.forget(before_s)


# How the flow of one pump divides among sections that open and shut: exact, and conserved.
#
# The pump's flow Q goes to its order as an exponential; section k lets `weight_k opening_k`
# through. While the sections can take it, section k gets Q weight_k opening_k / S, S the sum over
# all; what is more than the relief valve's pressure drives through them goes back into the tank:
#
#     flow_k = weight_k opening_k min(Q / S, most)
#
# Between two events (an order of the pump, an edge of a valve) this is integrated in closed form
# where the openings stand still, and by Gauss's rule while one moves; a ramp is cut where the
# relief valve opens or shuts, so that the integrand is smooth.

STILL = 1e-9
# Gauss's nodes and weights on [0, 1]: a ramp lasts some hundredths of the pump's time constant.
NODES, SHARES = np.polynomial.legendre.leggauss(8)
NODES, SHARES = 0.5 * (NODES + 1.0), 0.5 * SHARES
# Where in a ramp a change of the relief valve is looked for.
LOOKS = 6


class Event(NamedTuple):
    """The pump gets a new level (None: keeps it), or the slope of a section's opening changes."""

    at_s: float
    target_ml_s: float | None
    section: int
    slope: float


class _Piece(NamedTuple):
    """From `at_s` on: the pump's flow is target + off exp(-t / time), the openings are lines."""

    at_s: float
    events: int  # how many events lie behind it
    passed_ml: Floats
    pumped_ml: float
    target: float
    off: float
    time_s: float
    openings: Floats
    slopes: Floats

    def pump_ml_s(self, since_s: float) -> float:
        """Return what the pump gives."""
        return self.target + self.off * math.exp(-since_s / self.time_s)

    def pumped(self, since_s: float) -> float:
        """Return what the pump has given since `at_s`."""
        return self.target * since_s - self.off * self.time_s * math.expm1(-since_s / self.time_s)


class SectionFlow:
    """The sections' volumes; events may come in any order of time."""

    def __init__(
        self,
        weights: Sequence[float],
        *,
        up_s: float,
        down_s: float,
        most_ml_s: float,
        start_s: float,
        is_open: bool = False,
    ) -> None:
        """Make it at rest; `weights` add up to 1, `most_ml_s` is a whole boom's relief."""
        self._weights: Floats = np.array(weights, dtype=np.float64)
        self._up_s, self._down_s, self._most = up_s, down_s, most_ml_s
        count = len(self._weights)
        self._events: list[Event] = []
        nothing: Floats = np.zeros(count)
        openings = nothing + float(is_open)
        self._pieces = [_Piece(start_s, 0, nothing, 0.0, 0.0, 0.0, up_s, openings, nothing)]

    def pump(self, at_s: float, target_ml_s: float) -> None:
        """Let the pump go to a flow from `at_s` on."""
        self._add(Event(at_s, target_ml_s, 0, 0.0))

    def ramp(self, section: int, at_s: float, ramp_s: float, *, is_open: bool) -> None:
        """Let a section open or shut within `ramp_s` from `at_s` on."""
        slope = (1.0 if is_open else -1.0) / ramp_s
        self._add(Event(at_s, None, section, slope))
        self._add(Event(at_s + ramp_s, None, section, -slope))

    def volumes_ml(self, times_s: Floats) -> Floats:
        """Return (n, sections): the cumulative volumes at times that were not forgotten."""
        pieces = self._build()
        starts_s = np.array([piece.at_s for piece in pieces])
        owner = np.maximum(np.searchsorted(starts_s, times_s, side="right") - 1, 0)
        volumes: Floats = np.empty((len(times_s), len(self._weights)))
        for number in np.unique(owner).tolist():
            piece, mine = pieces[number], owner == number
            since_s = np.maximum(times_s[mine] - piece.at_s, 0.0)
            volumes[mine] = piece.passed_ml + self._through(piece, since_s)
        return volumes

    def volume_at(self, time_s: float) -> float:
        """Return the cumulative volume of all sections at one time."""
        pieces = self._build()
        piece = pieces[max(bisect_right(pieces, time_s, key=_at) - 1, 0)]
        since_s = np.array([max(time_s - piece.at_s, 0.0)])
        return float((piece.passed_ml + self._through(piece, since_s)[0]).sum())

    def pumped_ml(self, times_s: Floats) -> Floats:
        """Return what the pump has given: the sections' volumes and what went back."""
        pieces = self._build()
        found = []
        for time_s in times_s.tolist():
            piece = pieces[max(bisect_right(pieces, time_s, key=_at) - 1, 0)]
            found.append(piece.pumped_ml + piece.pumped(max(time_s - piece.at_s, 0.0)))
        return np.array(found)

    def forget(self, before_s: float) -> None:
        """Drop what is only needed for times before `before_s`."""
        pieces = self._build()
        last = max(bisect_right(pieces, before_s, key=_at) - 1, 0)
        behind = pieces[last].events
        self._pieces = [piece._replace(events=piece.events - behind) for piece in pieces[last:]]
        del self._events[:behind]

    def _add(self, event: Event) -> None:
        place = bisect_right(self._events, event.at_s, key=_at)
        self._events.insert(place, event)
        keep = bisect_right(self._pieces, place, key=lambda piece: piece.events)
        # A cut of a ramp has as many events behind it as the ramp: it may lie after the new one.
        while keep > 1 and self._pieces[keep - 1].at_s > event.at_s:
            keep -= 1
        del self._pieces[keep:]

    def _build(self) -> list[_Piece]:
        pieces = self._pieces
        while pieces[-1].events < len(self._events):
            last = pieces[-1]
            event = self._events[last.events]
            gap_s = max(event.at_s - last.at_s, 0.0)
            cut_s = self._cut_s(last, gap_s)
            pieces.append(self._after(last, gap_s, event) if cut_s is None else
                          self._after(last, cut_s, None))  # fmt: skip
        return pieces

    def _after(self, before: _Piece, since_s: float, event: Event | None) -> _Piece:
        flow_ml_s = before.pump_ml_s(since_s)
        time_s, target, slopes = before.time_s, before.target, before.slopes
        openings = np.clip(before.openings + slopes * since_s, 0.0, 1.0)
        if event is not None and event.target_ml_s is not None:
            target = event.target_ml_s
            time_s = self._up_s if target > flow_ml_s else self._down_s
        elif event is not None:
            slopes = slopes.copy()
            slopes[event.section] += event.slope
            slopes[np.abs(slopes) < STILL] = 0.0
        off = flow_ml_s - target
        through = self._through(before, np.array([since_s]))[0]
        return _Piece(
            at_s=before.at_s + since_s,
            events=before.events + (event is not None),
            passed_ml=before.passed_ml + through,
            pumped_ml=before.pumped_ml + before.pumped(since_s),
            target=target,
            off=off if abs(off) > STILL else 0.0,
            time_s=time_s,
            openings=openings,
            slopes=slopes,
        )

    def _through(self, piece: _Piece, since_s: Floats) -> Floats:
        """Return (n, sections): what has passed the sections since the piece began."""
        if piece.target == 0.0 and piece.off == 0.0:
            return np.zeros((len(since_s), len(self._weights)))
        if piece.slopes.any():
            return self._ramping(piece, since_s)
        ways = self._weights * piece.openings
        total = float(ways.sum())
        if not total > STILL:
            return np.zeros((len(since_s), len(self._weights)))
        return _limited(piece, since_s, self._most * total)[:, None] * (ways / total)

    def _ramping(self, piece: _Piece, since_s: Floats) -> Floats:
        if self._excess(piece, 1e-6) > 0.0:
            line = piece.openings * since_s[:, None] + 0.5 * piece.slopes * since_s[:, None] ** 2
            limited: Floats = self._most * self._weights * line
            return limited
        times = since_s[:, None] * NODES
        flow = piece.target + piece.off * np.exp(-times / piece.time_s)
        ways = self._weights * (piece.openings + piece.slopes * times[:, :, None])
        total = np.maximum(ways.sum(axis=2), STILL)
        per_way = flow / total * SHARES * since_s[:, None]
        result: Floats = (ways * per_way[:, :, None]).sum(axis=1)
        return result

    def _excess(self, piece: _Piece, since_s: float) -> float:
        """Return the pump's flow less what the sections can take."""
        total = float(self._weights @ (piece.openings + piece.slopes * since_s))
        return piece.pump_ml_s(since_s) - self._most * total

    def _cut_s(self, piece: _Piece, gap_s: float) -> float | None:
        """Return when the relief valve first opens or shuts within a ramp; None if it does not."""
        if not (gap_s > STILL and piece.slopes.any()):
            return None
        low_s = 1e-6
        was_over = self._excess(piece, low_s) > 0.0
        for look in range(1, LOOKS + 1):
            high_s = gap_s * look / LOOKS
            if high_s > low_s and (self._excess(piece, high_s) > 0.0) != was_over:
                for _ in range(50):
                    middle_s = 0.5 * (low_s + high_s)
                    if (self._excess(piece, middle_s) > 0.0) == was_over:
                        low_s = middle_s
                    else:
                        high_s = middle_s
                return high_s if high_s < gap_s - STILL else None
            low_s = max(high_s, low_s)
        return None


def _limited(piece: _Piece, since_s: Floats, most_ml_s: float) -> Floats:
    """Return the integral of the lesser of the pump's flow and `most_ml_s`."""
    begin, end = piece.target + piece.off, piece.target
    if max(begin, end) <= most_ml_s:
        return _pumped(piece, since_s)
    if min(begin, end) >= most_ml_s:
        return most_ml_s * since_s
    turn_s = -piece.time_s * math.log((most_ml_s - end) / piece.off)
    early, late = np.minimum(since_s, turn_s), np.maximum(since_s - turn_s, 0.0)
    if begin < most_ml_s:
        return _pumped(piece, early) + most_ml_s * late
    until_turn = _pumped(piece, np.array([turn_s]))
    after: Floats = np.where(late > 0.0, _pumped(piece, since_s) - until_turn, 0.0)
    return most_ml_s * early + after


def _pumped(piece: _Piece, since_s: Floats) -> Floats:
    result: Floats = piece.target * since_s
    result -= piece.off * piece.time_s * np.expm1(-since_s / piece.time_s)
    return result


def _at(each: Event | _Piece) -> float:
    return each.at_s

"""The border: how far inside it the spray ends and begins, and what fell beyond it.

Exclusions are borders: the field is what may be sprayed. Where only planned lines may be, their
ends are borders too, and all that falls between them is beyond.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import shapely

from analysis.changes import SPEED_MIN_M_S, Run, bisect
from analysis.holds import BESIDE_S, CLEAR_M
from analysis.lag import DWELL_MIN_S, Step, Verdict
from analysis.strips import GRAZE_M, Strip
from analysis.track import TOUCH_M, Bools, Floats, Ints, Track, in_field

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from analysis.flight_record import Orders
    from companion.core.prescription import Prescription

# Flow has ended below this part of what it was.
ENDED_BELOW = 0.02
# Cumulative volumes are rounded; less than this in one step is nothing.
NOTHING_ML = 1e-9
ELEMENT_M = 0.1
# How long before and after a change the strip must keep in the field. What a line is laid through
# may reach further, but not over a hold of the border; whether a change was missed is judged by the
# whole of both stretches.
AROUND_S = 1.0
# No sprayer takes longer; what was ordered before that was not ordered for this border.
DELAY_MAX_S = 3.0
# So many crossings of one valve and kind before their delays say how far they scatter.
ALIKE_MIN = 3
POSITION_SDS = 2.33


class OffTarget(NamedTuple):
    """Volumes beyond the border or in exclusions, and inside but off every planned line."""

    outside_ml: float
    off_line_ml: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BorderCrossing:
    """One crossing of the border by a strip that sprays on its inner side.

    `margin_m` is from the strip's first contact with the outside back to where the flow ended, or
    from its last contact on to where the flow began; >= 0 means that nothing fell outside.
    `delay_s` is from the order to that end or beginning of the flow, None where none is known.
    """

    valve: int
    kind: Literal["closing", "opening"]
    time_s: float
    margin_m: float
    speed_m_s: float = 0.0
    delay_s: float | None = None


class _Candidate(NamedTuple):
    """A crossing that may count: from a time well inside over the crossing to one well outside."""

    kind: Literal["opening", "closing"]
    near_s: float
    cross_s: float
    far_s: float


def border_crossings(strip: Strip, prescription: Prescription) -> list[BorderCrossing]:
    """Return the margins of one strip at every border that it sprayed up to or from."""
    track = strip.track
    candidates = list(_candidates(strip))
    contacts_s = _contacts_s(strip, prescription, candidates)
    switches = _switches(strip.orders)
    found: list[BorderCrossing] = []
    for candidate, contact_s in zip(candidates, contacts_s.tolist(), strict=True):
        flow_s = _flow_end_s(track, candidate.near_s, candidate.far_s)
        if flow_s is None or not contact_s < np.inf:  # it did not spray, or never was inside
            continue
        margin_m = track.value(track.distance_m, contact_s)
        margin_m -= track.value(track.distance_m, flow_s)
        found.append(
            BorderCrossing(
                valve=track.valve,
                kind=candidate.kind,
                time_s=candidate.cross_s,
                margin_m=-margin_m if candidate.kind == "opening" else margin_m,
                speed_m_s=track.value(track.speed_m_s, flow_s),
                delay_s=_delay_s(switches, flow_s, is_opening=candidate.kind == "opening"),
            )
        )
    return found


def _switches(orders: Orders) -> list[tuple[float, bool]]:
    """Return when a valve was ordered to open (True) or to close."""
    is_open = orders.duty > 0.0
    its = np.flatnonzero(np.diff(is_open, prepend=False))
    return list(zip(orders.at_s[its].tolist(), is_open[its].tolist(), strict=True))


def _delay_s(
    switches: Sequence[tuple[float, bool]], flow_s: float, *, is_opening: bool
) -> float | None:
    """Return how long before a flow began, or ended, it was ordered to."""
    last = bisect_right(switches, (flow_s, True)) - 1
    if last < 0 or switches[last][1] != is_opening:
        return None
    delay_s = flow_s - switches[last][0]
    return delay_s if delay_s <= DELAY_MAX_S else None


def margin_bound_m(crossings: Sequence[BorderCrossing], *, position_sd_m: float) -> float | None:
    """Return the mean margin that nobody can go below who lets nothing fall outside.

    Between an order, as carried out at the output, and the end of its flow lies a delay d that
    differs from one crossing to the next: the valve's own scatter, the phase of its pulses. (The
    jitter of what comes before the output is not in it, so the bound is rather too small.) Whoever
    orders does not know d beforehand, so the order must come early enough for the slowest: at the
    speed v a crossing then ends v (d_max - d) inside. At an opening it is the quickest that must
    not begin outside: v (d - d_min). Which valve it is can be known, so d_max and d_min are those
    of one valve and one kind in this flight, from `ALIKE_MIN` crossings on.

    The aircraft is not where it believes to be either, by s = `position_sd_m` along its path: with
    z = `POSITION_SDS` one crossing in a hundred would reach over. Both are independent:
    bound = sqrt(mean(v |d - d_extreme|)^2 + (z s)^2). None where nothing tells the delays.
    """
    alike: dict[tuple[int, str], list[BorderCrossing]] = {}
    for crossing in crossings:
        if crossing.delay_s is not None:
            alike.setdefault((crossing.valve, crossing.kind), []).append(crossing)
    slack_m: list[float] = []
    for group in alike.values():
        if len(group) < ALIKE_MIN:
            continue
        delays_s = np.array([crossing.delay_s for crossing in group], dtype=np.float64)
        speeds_m_s = np.array([crossing.speed_m_s for crossing in group])
        extreme_s = delays_s.max() if group[0].kind == "closing" else delays_s.min()
        slack_m += (speeds_m_s * np.abs(delays_s - extreme_s)).tolist()
    if not slack_m:
        return None
    return float(np.hypot(np.mean(slack_m), POSITION_SDS * position_sd_m))


def _candidates(strip: Strip) -> Iterator[_Candidate]:
    """Yield both ends of every visit to the field, where the strip is to spray there."""
    for first, last, early_s, late_s in _passes(strip.stretches):
        if not min(first.dwell_s, last.dwell_s) >= DWELL_MIN_S:
            continue
        opening = _Candidate("opening", first.end_s, first.start_s, early_s)
        closing = _Candidate("closing", last.start_s, last.end_s, late_s)
        for stretch, each in ((first, opening), (last, closing)):
            if stretch.rate_l_ha > 0.0 and _crosses(strip.track, each.cross_s):
                yield each


def _passes(stretches: Sequence[Run]) -> Iterator[tuple[Run, Run, float, float]]:
    """Yield the first and the last stretch of each visit to the field, and how far each reaches.

    Flow between two visits belongs to the nearer one.
    """
    first: Run | None = None
    early_s = stretches[0].start_s
    for i, run in enumerate(stretches):
        if not run.inside:
            early_s = run.start_s + 0.5 * run.dwell_s if i else run.start_s
            continue
        first = first or run
        if i + 1 == len(stretches):
            yield first, run, early_s, run.end_s
        elif not stretches[i + 1].inside:
            after = stretches[i + 1]
            share = 1.0 if i + 2 == len(stretches) else 0.5
            yield first, run, early_s, after.start_s + share * after.dwell_s
            first = None


def _crosses(track: Track, time_s: float) -> bool:
    """Return whether the record goes on beyond a border and the aircraft moves there."""
    within = track.time_s[0] < time_s < track.time_s[-1]
    return bool(within and track.value(track.speed_m_s, time_s) > SPEED_MIN_M_S)


def _flow_end_s(track: Track, near_s: float, far_s: float) -> float | None:
    """Return the outermost time with flow between a time inside and a time outside."""
    first, last = track.sample(min(near_s, far_s)), track.sample(max(near_s, far_s)) + 1
    drops = np.diff(track.volume_ml[first : last + 1])
    if not len(drops) or not drops.max() > NOTHING_ML:
        return None
    flowing = np.flatnonzero(drops > ENDED_BELOW * drops.max())
    # Interval i lies between samples i and i + 1: the outer one counts.
    index = flowing[0] if far_s < near_s else flowing[-1] + 1
    return float(track.time_s[first + index])


def _contacts_s(
    strip: Strip, prescription: Prescription, candidates: Sequence[_Candidate]
) -> Floats:
    """Return when the strip first touches the outside (or last does); NaN where never inside."""
    grazing_s = _edges_s(strip, prescription, candidates, strip.grazing, -GRAZE_M)
    exact_s = _edges_s(strip, prescription, candidates, strip.whole, -TOUCH_M)
    both = np.flatnonzero(np.isfinite(grazing_s) & np.isfinite(exact_s))
    # At an oblique border the strip's end goes over by ever more between the two; along a border
    # it stays where it is until the crossing.
    nearly_s = exact_s[both] + 0.9 * (grazing_s[both] - exact_s[both])
    along = strip.track.wholly_inside(
        prescription, strip.track.places(nearly_s), widen_m=-0.8 * GRAZE_M
    )
    contacts_s = grazing_s.copy()
    contacts_s[both] = np.where(along, grazing_s[both], exact_s[both])
    return contacts_s


def _edges_s(
    strip: Strip,
    prescription: Prescription,
    candidates: Sequence[_Candidate],
    inside: Bools,
    widen_m: float,
) -> Floats:
    """Return the times next to the crossings at which the strip is wholly inside, to 0.01 mm."""
    marks_s = strip.track.time_s[strip.track.marks]
    within = np.flatnonzero(inside)
    within_s = marks_s[within]
    found = np.full(len(candidates), np.nan)
    rows, marks, beyond = [], [], []
    for row, each in enumerate(candidates):
        low_s, high_s = min(each.near_s, each.cross_s), max(each.near_s, each.cross_s)
        first = int(np.searchsorted(within_s, low_s, "right"))
        end = int(np.searchsorted(within_s, high_s, "left"))
        if first < end:
            ahead = each.kind == "closing"
            mark = int(within[end - 1] if ahead else within[first])
            rows.append(row)
            marks.append(mark)
            beyond.append(mark + 1 if ahead else mark - 1)
    found[rows] = bisect(
        lambda t: strip.track.wholly_inside(prescription, strip.track.places(t), widen_m=widen_m),
        marks_s[np.array(marks, dtype=np.int64)],
        marks_s[np.array(beyond, dtype=np.int64)],
    )
    return found


def off_target_ml(strips: Sequence[Strip], prescription: Prescription) -> float:
    """Return the volume that fell outside the field."""
    return off_target(strips, prescription).outside_ml


def off_target(strips: Sequence[Strip], prescription: Prescription) -> OffTarget:
    """Return the volumes that fell outside the field, and inside it off every planned line.

    A strip is split into elements of at most 0.1 m across, each judged at its exact point at
    every sample that something falls.
    """
    outside_ml, off_line_ml = 0.0, 0.0
    lines = strips[0].track.planned
    planned = None if lines is None else lines.ground
    shapely.prepare(planned)
    for strip in strips:
        track = strip.track
        samples = _doubtful(strip)
        drops = track.volume_ml[samples + 1] - track.volume_ml[samples]
        samples, drops = samples[drops > NOTHING_ML], drops[drops > NOTHING_ML]
        if not len(samples):
            continue
        time_s = 0.5 * (track.time_s[samples] + track.time_s[samples + 1])
        count = int(np.ceil(track.width_m / ELEMENT_M - 1e-9))
        for offset in (np.arange(count) + 0.5) / count - 0.5:
            place = track.places(time_s).beside(float(offset * track.width_m))
            inside = in_field(prescription, *place)
            outside_ml += float(drops[~inside].sum()) / count
            if planned is not None:
                off_line = inside & ~shapely.contains_xy(planned, *place)
                off_line_ml += float(drops[off_line].sum()) / count
    return OffTarget(outside_ml, off_line_ml)


def _doubtful(strip: Strip) -> Ints:
    """Return the samples before which and after which the strip is not surely in the field."""
    marks = strip.track.marks
    sure = strip.whole[1:] & strip.whole[:-1]
    doubtful = np.repeat(~sure, np.diff(marks))
    return np.flatnonzero(doubtful).astype(np.int64)


def held_by_border(strip: Strip, prescription: Prescription, steps: Sequence[Step]) -> list[Step]:
    """Return the steps with those apart where the strip reaches over the border.

    There the border decides whether the valve is open, not the rate under the strip's centre. A
    valve that stays closed misses a change only where its strip keeps clear of the border.
    """
    marks_s = strip.track.time_s[strip.track.marks]
    over = np.concatenate(([0], np.cumsum(~strip.grazing)))
    starts_s = np.array([stretch.start_s for stretch in strip.stretches])
    times_s = np.array([step.change.time_s for step in steps])
    # Looked at all at once: most changes have no border within reach of what they were measured on.
    last = over[np.searchsorted(marks_s, times_s + AROUND_S, "right")]
    is_near = (last > over[np.searchsorted(marks_s, times_s - AROUND_S)]).tolist()
    found: list[Step] = []
    for step, near in zip(steps, is_near, strict=True):
        change = step.change
        missed = step.verdict is Verdict.MISSED
        if not missed and (step.verdict is not Verdict.MEASURED or change.border or not near):
            found.append(step)
            continue
        around_s = np.inf if missed and not change.border else AROUND_S
        span_s = (change.time_s - around_s, change.time_s + around_s)
        if not change.border:
            span_s = _in_two_stretches(starts_s, change.time_s, span_s)
        first = int(np.searchsorted(marks_s, span_s[0], "left"))
        end = int(np.searchsorted(marks_s, span_s[1], "right" if change.border else "left"))
        index = np.arange(first, end)
        if change.border:
            index = index[strip.rates_at(marks_s[index]) > 0.0]
        clear = strip.grazing[index].all()
        if clear and missed and step.dry:
            index = index[:: max(len(index) // 10, 1)]
            beside = np.abs(marks_s[index] - change.time_s) > (BESIDE_S if change.border else 0.0)
            clear = strip.track.wholly_inside(
                prescription, strip.track.places(marks_s[index[beside]]), widen_m=CLEAR_M
            ).all()
        held = replace(step, verdict=Verdict.BORDER, lag_distance_m=None)
        found.append(step if clear else held)
    return found


def _in_two_stretches(
    starts_s: Floats, change_s: float, span_s: tuple[float, float]
) -> tuple[float, float]:
    """Return a span within the stretch that a change ends and the one that it begins."""
    after = int(np.argmin(np.abs(starts_s - change_s)))
    last_s = float(starts_s[after + 1]) if after + 1 < len(starts_s) else np.inf
    # The span's own end counts, that of a stretch does not.
    return (
        max(span_s[0], float(starts_s[max(after - 1, 0)])),
        min(float(np.nextafter(span_s[1], np.inf)), last_s),
    )

"""How much was applied against what was prescribed: on the ground, and in P1's total flow.

SA_k = (1 - |S'_k - S_k| / S_k) 100 %, SA = mean of SA_k (P1 Eqs. 18 and 19). It says nothing where
nothing is prescribed.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import SPEED_MIN_M_S
from analysis.track import rise_over
from analysis.transitions import ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.strips import Strip
    from analysis.track import Bools, Floats
    from companion.core.boom import Boom
    from companion.core.prescription import Prescription

# ------------------------------------------------------------------------------------ on the ground


@dataclass(frozen=True, slots=True, kw_only=True)
class Misapplied:
    """Volume in the wrong place, and prescribed volume, at marks of all strips."""

    time_s: Floats
    wrong_ml: Floats
    asked_ml: Floats


def misapplied_parts(strips: Sequence[Strip]) -> Misapplied:
    """Return what is in the wrong place, too much or too little, mark by mark.

    Applied and prescribed volume are averaged along the track over one PWM period, every 0.1 m,
    where the strip is wholly in the field. What falls outside is not in it; see `off_target_ml`.
    """
    parts = [_misapplied(strip) for strip in strips]
    return Misapplied(
        time_s=np.concatenate([part.time_s for part in parts]),
        wrong_ml=np.concatenate([part.wrong_ml for part in parts]),
        asked_ml=np.concatenate([part.asked_ml for part in parts]),
    )


def _misapplied(strip: Strip) -> Misapplied:
    track = strip.track
    marks, metres = track.marks, np.gradient(track.distance_m[track.marks])
    run_m = rise_over(track.distance_m, track.period_steps)[marks]
    given = rise_over(track.volume_ml, track.period_steps)[marks]
    asked = rise_over(strip.asked_ml, track.period_steps)[marks]
    counts = strip.grazing & (run_m > SPEED_MIN_M_S * track.period_s)
    weight = metres[counts] / run_m[counts]
    return Misapplied(
        time_s=track.time_s[marks][counts],
        wrong_ml=np.abs(given - asked)[counts] * weight,
        asked_ml=asked[counts] * weight,
    )


def misapplied_percent(strips: Sequence[Strip]) -> float | None:
    """Return the volume in the wrong place over the prescribed one."""
    parts = misapplied_parts(strips)
    asked_ml = float(parts.asked_ml.sum())
    return 100.0 * float(parts.wrong_ml.sum()) / asked_ml if asked_ml > 0.0 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneVolume:
    """What fell on a zone, and what was prescribed along what was flown of it."""

    given_ml: float
    asked_ml: float


def zone_volumes(strips: Sequence[Strip], prescription: Prescription) -> dict[str, ZoneVolume]:
    """Return the volumes of every zone that a strip's centre came over.

    Where zones overlap, their names are joined; ground of the field without a zone has none.
    """
    given_ml: dict[frozenset[int], float] = defaultdict(float)
    asked_ml: dict[frozenset[int], float] = defaultdict(float)
    for strip in strips:
        inside = [run for run in strip.runs if run.inside]
        ends_s = np.array([(run.start_s, run.end_s) for run in inside]).reshape(-1, 2)
        for totals, values in ((given_ml, strip.track.volume_ml), (asked_ml, strip.asked_ml)):
            volumes = np.diff(strip.track.at(values, ends_s), axis=1)[:, 0]
            for run, volume_ml in zip(inside, volumes.tolist(), strict=True):
                totals[run.zones] += volume_ml
    return {
        "+".join(prescription.zone_name(zone) for zone in sorted(zones)): ZoneVolume(
            given_ml=given_ml[zones], asked_ml=asked
        )
        for zones, asked in asked_ml.items()
    }


def volume_error_percent(
    strips: Sequence[Strip], prescription: Prescription
) -> tuple[float | None, dict[str, float]]:
    """Return applied against prescribed volume, in all and by zone, along what was flown.

    Zones that nothing is prescribed for have no error in percent.
    """
    zones = zone_volumes(strips, prescription)
    by_zone = {
        name: _error_percent(zone.given_ml, zone.asked_ml)
        for name, zone in zones.items()
        if zone.asked_ml > 0.0
    }
    asked_all = sum(zone.asked_ml for zone in zones.values())
    given_all = sum(zone.given_ml for zone in zones.values())
    return (_error_percent(given_all, asked_all) if asked_all > 0.0 else None), by_zone


def section_error_percent(strips: Sequence[Strip], boom: Boom) -> dict[str, float]:
    """Return applied against prescribed volume of each section, inside the field.

    A pump gives all sections of a boom one flow: what it gives to one too much another lacks.
    """
    found = {}
    for strip, valve in zip(strips, boom.valves, strict=True):
        ends_s = np.array([(run.start_s, run.end_s) for run in strip.runs if run.inside])
        given_ml, asked_ml = (
            float(np.diff(strip.track.at(values, ends_s.reshape(-1, 2)), axis=1).sum())
            for values in (strip.track.volume_ml, strip.asked_ml)
        )
        if asked_ml > 0.0:
            found[valve.name] = _error_percent(given_ml, asked_ml)
    return found


def _error_percent(given_ml: float, asked_ml: float) -> float:
    return 100.0 * (given_ml - asked_ml) / asked_ml


# ------------------------------------------------------------------------------------ in total flow

SAMPLE_S = 0.01
SETTLED_AFTER_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowAccuracy:
    """Spraying accuracy of all samples, of those settled and of those after a start [%].

    None where there is no such sample: short zones never settle.
    """

    all_percent: float | None
    settled_percent: float | None
    starting_percent: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowSamples:
    """P1's data points: SA_k [%], its time, and the one rate under all strips (else NaN).

    `undefined` samples in the field had nothing prescribed: Eq. 18 divides by it.
    """

    time_s: Floats
    accuracy_percent: Floats
    rate_l_ha: Floats
    undefined: int


def flow_samples(strips: Sequence[Strip]) -> FlowSamples:
    """Return SA_k of the total flow, one-period mean, every 10 ms in the field."""
    track = strips[0].track
    every = max(round(SAMPLE_S / track.step_s), 1)
    time_s = track.time_s[::every]
    given = np.zeros(len(time_s))
    asked = np.zeros(len(time_s))
    inside = np.ones(len(time_s), dtype=np.bool_)
    moving = track.speed_m_s[::every] > SPEED_MIN_M_S
    rate_l_ha = strips[0].rates_at(time_s)
    for strip in strips:
        each = strip.track
        rates = strip.rates_at(time_s)
        given += rise_over(each.volume_ml, each.period_steps)[::every] / each.period_s
        metres_s = each.speed_m_s[::every] * each.across_m[::every]
        asked += rates * ML_M_PER_L_HA_M * metres_s
        inside &= strip.inside_at(time_s)
        rate_l_ha = np.where(rates == rate_l_ha, rate_l_ha, np.nan)
    counts = inside & moving & (asked > 0.0)
    return FlowSamples(
        time_s=time_s[counts],
        accuracy_percent=100.0 * (1.0 - np.abs(given - asked)[counts] / asked[counts]),
        rate_l_ha=rate_l_ha[counts],
        undefined=int((inside & moving & ~(asked > 0.0)).sum()),
    )


def flow_accuracy(strips: Sequence[Strip]) -> FlowAccuracy:
    """Return P1's SA of the total flow, one-period mean, sampled every 10 ms."""
    samples = flow_samples(strips)
    accuracy = samples.accuracy_percent
    changed_s, started_s = _since(strips, samples.time_s)
    return FlowAccuracy(
        all_percent=_mean(accuracy),
        settled_percent=_mean(accuracy[changed_s >= SETTLED_AFTER_S]),
        starting_percent=_mean(accuracy[started_s < SETTLED_AFTER_S]),
    )


def _since(strips: Sequence[Strip], time_s: Floats) -> tuple[Floats, Floats]:
    """Return the time since any strip's last change of rate, and since the boom's last start."""
    starts = [run.start_s for strip in strips for run in strip.stretches]
    edges_s = np.unique(np.array(starts))
    # Between two edges every rate is constant: any time between them tells.
    middles_s = np.append(0.5 * (edges_s[1:] + edges_s[:-1]), edges_s[-1] + 1e-6)
    sprays = np.zeros(len(edges_s), dtype=np.bool_)
    for strip in strips:
        sprays |= strip.rates_at(middles_s) > 0.0
    begins: Bools = sprays & ~np.concatenate(([False], sprays[:-1]))
    return _last(edges_s, time_s), _last(edges_s[begins], time_s)


def _last(events_s: Floats, time_s: Floats) -> Floats:
    """Return the time since the last event; infinite before the first."""
    padded = np.concatenate(([-np.inf], events_s))
    since: Floats = time_s - padded[np.searchsorted(padded, time_s, "right") - 1]
    return since


def _mean(values: Floats) -> float | None:
    return float(values.mean()) if len(values) else None


# Spraying accuracy by prescribed rate, as P1's Table 5 has it.
#
# Eq. 19 is a mean over data points. A row here knows how many it has, so that rows add up, weighted
# by them, to the accuracy of a flight, and the rows of several flights to those of all.


@dataclass(frozen=True, slots=True, kw_only=True)
class RateAccuracy:
    """SA of the data points over one rate; the rate is None where the strips had several."""

    rate_l_ha: float | None
    percent: float
    samples: int


def accuracy_by_rate(strips: Sequence[Strip]) -> tuple[RateAccuracy, ...]:
    """Return a flight's SA by rate, lowest first; what lay over several rates is last.

    Transitions count for the rate that they lead to: its ground is where they are.
    """
    found = flow_samples(strips)
    rates, accuracy = found.rate_l_ha, found.accuracy_percent
    parts = [(float(rate), accuracy[rates == rate]) for rate in np.unique(rates[~np.isnan(rates)])]
    parts.append((float("nan"), accuracy[np.isnan(rates)]))
    return tuple(
        RateAccuracy(
            rate_l_ha=None if np.isnan(rate) else rate,
            percent=float(part.mean()),
            samples=len(part),
        )
        for rate, part in parts
        if len(part)
    )

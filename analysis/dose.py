"""What fell on the ground against what was prescribed there: misapplied volume, dose of zones."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import SPEED_MIN_M_S
from analysis.track import rise_over

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.strips import Strip
    from analysis.track import Floats
    from companion.core.boom import Boom
    from companion.core.prescription import Prescription


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

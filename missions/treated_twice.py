"""Litres where the companion closes valves over treated ground (`coverage.switch_off_percent`).

A valve needs none where a line flown before has treated its strip; what still falls twice is less
than one valve's width of each overlap. Only what the same sortie has sprayed counts: whether the
next one knows of it is the pilot's `--continue`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.boom import Boom
from missions.demand import M2_PER_HA, Rates, valve_places
from missions.extents import Extents, extents_of
from missions.plan import Settings, Sortie
from missions.strips import Floats, Objects, directions, lengths_m, whole

# Treated ground is looked at so often along a line, and in so many places across a valve's strip.
ALONG_M, ACROSS = 0.5, 5


@dataclass(frozen=True, slots=True, kw_only=True)
class _Closing:
    """The boom, and its valves' strips as (right_m, width_m).

    They close from this share of treated ground on.
    """

    flown: Boom
    places: Floats
    closes_from: float
    extents: Extents | None


def counted(
    sorties: Sequence[Sortie], rates: Rates, settings: Settings, limit: BaseGeometry, flown: Boom
) -> tuple[Sortie, ...]:
    """Return the sorties with what each leg needs, and what of it falls on treated ground.

    As they are where no valve closes.
    """
    share = settings.switch_off_percent
    if share is None or not settings.valves:
        return tuple(sorties)
    kept_m = settings.border_buffer_m
    boom = _Closing(
        flown=flown,
        places=valve_places(settings.swath_width_m, settings.valves),
        closes_from=share / 100.0,
        extents=None
        if kept_m is None
        else extents_of(limit, width_m=settings.swath_width_m, buffer_m=kept_m),
    )
    return tuple(_counted(sortie, rates, boom) for sortie in sorties)


def _counted(sortie: Sortie, rates: Rates, boom: _Closing) -> Sortie:
    flown = [number for number, leg in enumerate(sortie.legs) if leg.kind == "spray"]
    if not flown:
        return sortie
    legs = list(sortie.legs)
    lines = np.array([[*legs[at].points[0], *legs[at].points[-1]] for at in flown])
    strips = boom.flown.strips(lines)
    earlier = _earlier(strips)
    for row, at in enumerate(flown):
        litres_l, twice_l = legs[at].volume_l, 0.0
        if earlier[row]:
            litres_l, twice_l = _litres(lines[row], whole(strips[earlier[row]]), rates, boom)
        legs[at] = replace(legs[at], volume_l=litres_l, overlap_l=twice_l)
    return replace(sortie, legs=tuple(legs))


def _earlier(strips: Objects) -> list[list[int]]:
    """Return which strips, flown before, lie under each."""
    found: list[list[int]] = [[] for _ in strips]
    one, other = shapely.STRtree(strips).query(strips, predicate="intersects")
    for at, before in zip(one.tolist(), other.tolist(), strict=True):
        if before < at:
            found[at].append(before)
    return found


def _litres(
    line: Floats, treated: BaseGeometry, rates: Rates, boom: _Closing
) -> tuple[float, float]:
    """Return what a line needs, and what of it falls on treated ground."""
    shapely.prepare(treated)
    length_m = float(lengths_m(line[None])[0])
    along = directions(line[None])[0]
    right = np.array([along[1], -along[0]])
    count = max(1, round(length_m / ALONG_M))
    places = line[:2] + along * ((np.arange(count) + 0.5) * length_m / count)[:, None]
    across = (np.arange(ACROSS) + 0.5) / ACROSS - 0.5
    litres = twice = 0.0
    for right_m, width_m in boom.places.tolist():
        middle = places + right * right_m
        rate = np.nan_to_num(rates.rates_at(middle[:, 0], middle[:, 1]), nan=0.0)
        if boom.extents is not None:
            to_right = np.broadcast_to(right, places.shape)
            rate = rate * boom.extents.is_open(places, to_right, (right_m, width_m))
        points = middle[:, None, :] + right * (across * width_m)[:, None]
        share = shapely.contains_xy(treated, points[..., 0], points[..., 1]).mean(axis=1)
        rate = np.where(share >= boom.closes_from - 1e-9, 0.0, rate)
        each_l = rate * width_m * length_m / count / M2_PER_HA
        litres += float(each_l.sum())
        twice += float((each_l * share).sum())
    return litres, twice

"""How far the sorties of a plan must fly without spraying, whatever their order."""

from __future__ import annotations

import math

import numpy as np

from missions.bands import main_course
from missions.energy import J_WH
from missions.plan import Plan
from missions.strips import Floats, directions, lengths_m

# So many places of a pass, and slopes, are looked at.
SAMPLES, SLOPES = 16, 41
PARALLEL = math.cos(math.radians(1.0))
# Passes whose litres by the metre differ by less count as even.
EVEN = 0.01


def least_idle_m(
    lines: Floats, litres: Floats, depots: Floats, *, usable_l: float, longest_m: float = math.inf
) -> float:
    """Return a lower bound of ferries and transits together.

    Let h be a height that is 0 at the depots, rises by 1 a metre at most, and by s at most along
    the passes. A sortie that sprays S metres and flies I without is at most I / 2 + s S / 4 high
    in the mean: it climbed there, and will climb down. So I is at least twice its mean height less
    s S / 2, and S is what a tank or a battery lets it spray. With s = 0 this is the bound of
    Haimovich and Rinnooy Kan (1985) across the passes; s = 1 allows for sorties out and back. The
    s that gives most is taken. Passes in other courses than most count as ways that cost nothing;
    where rates differ, the mean is that of the litres, and less is known of the climb.
    """
    if not len(lines) or not float(litres.sum()) > 0.0:
        return 0.0
    along = np.array(main_course(lines))
    cosine = np.abs(directions(lines) @ along)
    main = cosine > PARALLEL
    length_m = lengths_m(lines)
    by_metre = litres[main] / length_m[main]
    is_even = float(by_metre.max()) <= (1.0 + EVEN) * float(by_metre.min())
    shares = (np.arange(SAMPLES) + 0.5) / SAMPLES
    step = lines[main, 2:] - lines[main, :2]
    places = lines[main, None, :2] + shares[None, :, None] * step[:, None, :]
    away = places[None] - depots[:, None, None, :]
    u, v = np.abs(away @ along), np.abs(away @ np.array([-along[1], along[0]]))
    bends = np.arccos(np.clip(cosine[~main], 0.0, 1.0))
    least_m = 0.0
    for s in np.linspace(0.0, 1.0, SLOPES).tolist():
        far = np.hypot(u, v)
        height = np.where(u <= s * far, far, s * u + math.sqrt(1.0 - s * s) * v)
        mean_m = height.min(axis=0).mean(axis=1)
        flat = math.acos(s)
        slopes = np.where(bends >= flat, 1.0, np.cos(flat - bends))
        aside_m = float((slopes * length_m[~main]).sum())
        climb_m = s * float(length_m[main].sum())
        found = [2.0 / usable_l * float(mean_m @ litres[main]) - climb_m]
        if is_even:
            longest_m = min(longest_m, usable_l / float(by_metre.min()))
            found.append(2.0 / longest_m * float(mean_m @ length_m[main]) - climb_m / 2.0)
        least_m = max(least_m, max(found) - aside_m)
    return least_m


def least_idle_of(plan: Plan) -> float:
    """Return what the ferries and transits of a plan come to at least, for its passes."""
    legs = [leg for sortie in plan.sorties for leg in sortie.legs if leg.kind == "spray"]
    legs = [leg for leg in legs if leg.length_m > 0.0]
    settings, longest_m = plan.settings, math.inf
    battery = settings.battery
    if legs and battery is not None and battery.capacity_wh is not None:
        lightest_w = min(battery.cruise_w, battery.hover_w)
        seconds = battery.usable_wh * J_WH / lightest_w
        longest_m = seconds * max(leg.speed_m_s for leg in legs)
    return least_idle_m(
        np.array([[*leg.points[0], *leg.points[-1]] for leg in legs]).reshape(-1, 4),
        np.array([leg.volume_l for leg in legs]),
        np.array(plan.depots),
        usable_l=settings.usable_l,
        longest_m=longest_m,
    )

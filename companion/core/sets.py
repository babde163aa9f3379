"""Which nozzle set sprays which zone: a change of set lies on the boundary, never inside a zone."""

from __future__ import annotations

from collections.abc import Callable

from companion.core.crossings import Route
from companion.core.nozzle import NozzleSet, choose_set
from companion.core.schedule import Dosing

# Which set sprays which rate [L/ha], for the zones in view.
SetOfRate = tuple[tuple[float, int], ...]

# A set is kept while the flow stays within this of what was measured.
BELOW_MIN, ABOVE_MAX = 1.0 / 1.1, 1.02


def sets_ahead(
    sets: tuple[NozzleSet, ...],
    route: Route,
    *,
    in_use: int,
    before: SetOfRate,
    flow_of: Callable[[float], float],
    now_s: float,
) -> tuple[int, SetOfRate]:
    """Return the set in use, and the set of each rate on a route: chosen as it comes into view.

    Chosen once, so that the noise of the speed does not change what is ordered already; given up
    only where it can no longer deliver. `flow_of` is the boom's flow [L/min] for a rate.
    """
    if len(sets) == 1:
        return 0, ()
    known, found = dict(before), dict[float, int]()
    last = in_use
    for crossing in route:
        rate = crossing.rate_l_ha
        if not rate:
            continue
        if rate not in found:
            flow_l_min, kept = flow_of(rate), known.get(rate)
            if kept is None or not _delivers(sets[kept], flow_l_min):
                kept = choose_set(sets, flow_l_min, current=last)
            found[rate] = kept
        last = found[rate]
        # The first zone in view is entered with its own set, however far ahead it still is.
        if crossing.at_s <= now_s or len(found) == 1:
            in_use = last
    return in_use, tuple(found.items())


def _delivers(nozzles: NozzleSet, flow_l_min: float) -> bool:
    low, high = nozzles.flow_min_l_min * BELOW_MIN, nozzles.flow_max_l_min * ABOVE_MAX
    return low <= flow_l_min <= high


def dosing_by_valve(
    sets: tuple[NozzleSet, ...], in_use: int, of_rate: SetOfRate, dose: Callable[[int], Dosing]
) -> Callable[[int], Dosing]:
    """Return each valve's dosing: by the set of its rate, closed where that set lacks the valve.

    `dose` makes the dosing of a set. A rate that only the sides of the boom meet is sprayed with
    the set in use: the boom's middle decides.
    """
    chosen = dict(of_rate)
    doses = {number: dose(number) for number in {in_use, *chosen.values()}}
    if len(doses) == 1:
        members, one = sets[in_use].valves, doses[in_use]
        return lambda valve: one if valve in members else _shut

    def of_valve(valve: int) -> Dosing:
        def duty(rate_l_ha: float, speed_m_s: float) -> float:
            number = chosen.get(rate_l_ha, in_use)
            return doses[number](rate_l_ha, speed_m_s) if valve in sets[number].valves else 0.0

        return duty

    return of_valve


def _shut(rate_l_ha: float, speed_m_s: float) -> float:  # noqa: ARG001
    """Return the duty of a valve that the set in use does not have."""
    return 0.0

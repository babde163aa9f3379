"""The routes of all valves as one: what the boom as a whole is prescribed along its way.

A pump makes the flow of all sections together, and an atomiser's speed follows that flow. The
rate of the whole is the mean of the strips' rates by their widths; closed strips count as 0.
"""

from __future__ import annotations

from itertools import pairwise

from companion.core.boom import Boom
from companion.core.crossings import Crossing, Route


def boom_route(
    routes: tuple[Route, ...], boom: Boom, *, merge_s: float = 0.0, shuts_outside: bool = False
) -> Route:
    """Return the mean rate over the boom; None where every strip is closed.

    Sections cross a slanting boundary one after the other. Steps between two flows that are nearer
    to each other than `merge_s` become one, at the moment at which it carries the same volume.
    Where every strip is closed, the boom is outside as soon as one of them is; with
    `shuts_outside` it is closed there.

    >>> from companion.core.boom import Valve
    >>> boom = Boom(width_m=4.0, valves=tuple(
    ...     Valve(name=name, right_m=0.0, forward_m=0.0, width_m=w) for name, w in (("1", 1.0),
    ...                                                                             ("2", 3.0))))
    >>> left = (Crossing(0.0, None, True, 5.0), Crossing(1.0, 20.0, False, 5.0))
    >>> right = (Crossing(0.0, None, True, 5.0), Crossing(1.5, 20.0, False, 5.0))
    >>> [(step.at_s, step.rate_l_ha) for step in boom_route((left, right), boom)]
    [(0.0, None), (1.0, 5.0), (1.5, 20.0)]
    """
    widths = (2.0 * boom.half_width_m).tolist()
    whole_m = sum(widths)
    crossings: dict[float, list[tuple[int, Crossing]]] = {}
    for valve, route in enumerate(routes):
        for crossing in route[1:]:
            crossings.setdefault(crossing.at_s, []).append((valve, crossing))
    rates = [route[0].rate_l_ha or 0.0 for route in routes]
    is_outside = [route[0].outside for route in routes]

    def whole(at_s: float, speed_m_s: float) -> Crossing:
        rate = sum(rate * width for rate, width in zip(rates, widths, strict=True)) / whole_m
        outside = any(is_outside)
        if rate > 0.0 and not (outside and shuts_outside):
            return Crossing(at_s, rate, False, speed_m_s)
        return Crossing(at_s, None, outside, speed_m_s)

    first = routes[len(routes) // 2][0]
    made = [whole(first.at_s, first.speed_m_s)]
    for at_s in sorted(crossings):
        here = crossings[at_s]
        for valve, crossing in here:
            rates[valve] = crossing.rate_l_ha or 0.0
            is_outside[valve] = crossing.outside
        now = whole(at_s, sum(crossing.speed_m_s for _, crossing in here) / len(here))
        if not now.is_as(made[-1]):
            made.append(now)
    return _merged(tuple(made), merge_s) if merge_s > 0.0 else tuple(made)


def _merged(route: Route, merge_s: float) -> Route:
    made = [route[0]]
    i = 1
    while i < len(route):
        last = i
        while (
            last + 1 < len(route)
            and route[last + 1].at_s - route[i].at_s < merge_s
            and all(step.rate_l_ha is not None for step in route[i - 1 : last + 2])
        ):
            last += 1
        made.append(_as_one(route[i - 1 : last + 1]))
        i = last + 1
    return tuple(made)


def _as_one(steps: Route) -> Crossing:
    """Return the steps behind the first as one, where a sharp one would carry their volume."""
    end = steps[-1]
    if len(steps) == 2:
        return end
    rises = [(step.at_s, (step.rate_l_ha or 0.0) - (ahead.rate_l_ha or 0.0))
             for ahead, step in pairwise(steps)]  # fmt: skip
    rise = sum(each for _, each in rises)
    if rise == 0.0:
        return end
    at_s = sum(at_s * each for at_s, each in rises) / rise
    return end._replace(at_s=min(max(at_s, steps[1].at_s), end.at_s))


def bridged(route: Route, gap_s: float) -> Route:
    """Return the route with closed stretches shorter than `gap_s` at the rate before them.

    What cannot stop and start again in the time goes on; whether anything comes out is the
    valves' affair.
    """
    made: list[Crossing] = [route[0]]
    for i in range(1, len(route)):
        step = route[i]
        if step.rate_l_ha is None and made[-1].rate_l_ha is not None:
            again = (each.at_s for each in route[i:] if each.rate_l_ha is not None)
            follows_s = next(again, float("inf"))
            if follows_s - step.at_s < gap_s:
                continue
        if not step.is_as(made[-1]):
            made.append(step)
    return tuple(made)

"""Which lines cover a field: several layouts are drawn, and the quickest tour of them is taken.

A pass along the whole border with lines inside; lines from border to border with passes only where
they are needed; such lines that begin anew at edges along them.
"""

from __future__ import annotations

from missions.angle import LAYOUT_WEIGHT, cost_s, ranked
from missions.coverage import reachable
from missions.field import Field
from missions.fitted_lines import fitted_lines, has_edges_along
from missions.free_space import free_space
from missions.one_tour import LINES_MAX, Tour, tour_of
from missions.open_lines import LEFT_SHARE, needed_passes, open_lines
from missions.patches import patches
from missions.plan import Settings
from missions.strips import Floats, joined, lengths_m
from missions.swaths import border_passes, inner_ground, inner_lines
from missions.turns import Motion
from missions.worth import LEFT_SHARE as WORTH_LEFT
from missions.worth import worthwhile

# Of the best courses so many are drawn in full; of the layouts so many are gone through line by
# line, and only the best one where it has more lines than this.
ANGLES_TRIED, LAYOUTS_TRIED, MANY_LINES = 2, 2, 100
# Simpler borders and what lines leave out come to 0.2 % of the ground at most, with a little for
# how both are measured; lines alone may always leave out 0.02 %.
LOST_MAX, LEFT_MIN = 0.0018, 0.0002


def spray_lines(field: Field, settings: Settings, motion: Motion) -> tuple[Floats, float]:
    """Return the lines that cover the field, and the course of the parallel ones."""
    width_m, area_m2 = settings.swath_width_m, field.spray.area
    drawn = _layouts(field, settings, motion)
    if max(len(lines) for _, lines in drawn) > LINES_MAX:
        costs = [
            cost_s(lines, motion, width_m, area_m2, weight=LAYOUT_WEIGHT) for _, lines in drawn
        ]
        angle_deg, lines = drawn[costs.index(min(costs))]
        return lines, angle_deg
    space = free_space(field.fly)

    def cost(tour: Tour) -> float:
        doubled_m2 = max(float(lengths_m(tour.lines).sum()) * width_m - area_m2, 0.0)
        return tour.seconds + LAYOUT_WEIGHT * doubled_m2 / (width_m * settings.speed_m_s)

    target = reachable(field.spray, width_m)
    tours = [(angle_deg, tour_of(lines, space, motion)) for angle_deg, lines in drawn]
    best = sorted(tours, key=lambda each: cost(each[1]))[:LAYOUTS_TRIED]
    if len(best[0][1].lines) > MANY_LINES:
        best = best[:1]
    better = [
        (
            angle_deg,
            tour_of(
                worthwhile(
                    tour, target, width_m, left_share=min(WORTH_LEFT, _spare(field, settings))
                ),
                space,
                motion,
            ),
        )
        for angle_deg, tour in best
    ]
    angle_deg, tour = min(better, key=lambda each: cost(each[1]))
    return tour.lines, angle_deg


def _spare(field: Field, settings: Settings) -> float:
    """Return what share of the ground lines may leave out, beside what simpler borders gave up."""
    reached_m2 = reachable(field.limit, settings.swath_width_m).area
    return max(LOST_MAX - field.given_up_m2 / reached_m2, LEFT_MIN)


def _layouts(field: Field, settings: Settings, motion: Motion) -> list[tuple[float, Floats]]:
    """Return (course, lines) of each layout."""
    width_m, ground = settings.swath_width_m, field.spray
    left_share = min(LEFT_SHARE, _spare(field, settings) / 2.0)
    inner, passes = inner_ground(ground, width_m), border_passes(ground, width_m)
    if settings.angle_deg is None:
        angles = [angle for _, angle in ranked(inner, ground, width_m=width_m, motion=motion)]
        angles = angles[:ANGLES_TRIED]
    else:
        angles = [settings.angle_deg]
    drawn: list[tuple[float, Floats]] = []
    for number, angle_deg in enumerate(angles):
        choices = []
        if number == 0:
            choices.append(joined([passes, inner_lines(inner, width_m, angle_deg)]))
        straights = [open_lines(ground, width_m, angle_deg)]
        if number == 0 and has_edges_along(ground, width_m, angle_deg):
            straights.append(fitted_lines(ground, width_m, angle_deg, motion))
        for straight in straights:
            if len(straight):
                more = needed_passes(straight, passes, ground, width_m, left_share=left_share)
                choices.append(joined([more, straight]))
        for lines in choices:
            more = patches(lines, ground, width_m, left_share=left_share)
            drawn.append((angle_deg, joined([lines, more])))
    return drawn

"""Laws of spraying on planned lines, for any lines and any state."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.crossings import Route, find_routes
from companion.core.options.lines import Lines, Piece, Polyline, add_off_lines
from companion.core.prescription import Prescription, Zone
from companion.core.types import MissionLeg, VehicleState
from tests.builders import along, boom, flying
from tests.companion.test_core_laws import turned

BOOM = boom()
BACK_S, AHEAD_S = 0.3, 1.5


def field(angle: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)) -> Prescription:
    corners = [turned(x, y, angle, shift) for x, y in ((-90, -90), (90, -90), (90, 90), (-90, 90))]
    return Prescription([Zone(name="all", polygon=shapely.Polygon(corners), rate_l_ha=20.0)])


FIELD = field()


def found(lines: Lines, state: VehicleState, ground: Prescription = FIELD) -> tuple[Route, ...]:
    state = replace(state, mode="GUIDED")  # by position and course alone
    flown = lines.flown(state, back_s=BACK_S, ahead_s=AHEAD_S, reach_m=BOOM.reach_m)
    return find_routes(
        ground, state, BOOM, back_s=BACK_S, ahead_s=AHEAD_S, border="inside",
        border_buffer_m=0.05, across="centre",
        close_more=partial(add_off_lines, flown=flown, boom=BOOM, strict=True),
    )  # fmt: skip


def rate_at(route: Route, at_s: float) -> float | None:
    return [c.rate_l_ha for c in route if c.at_s <= at_s][-1]


PLACES = st.tuples(st.floats(-50, 50), st.floats(-50, 50))
# Gentle bends and sharp ones, short pieces and long ones.
POLYLINES = st.lists(PLACES, min_size=2, max_size=5).map(tuple)
LINES = st.lists(POLYLINES, min_size=1, max_size=6)


def planned(polylines: list[Polyline]) -> Lines | None:
    try:
        return Lines(polylines=tuple(polylines))
    except ValueError:  # all of them are points
        return None


def is_beside(piece: Piece, place: np.ndarray, half_m: float) -> bool:
    x, y = place[0] - piece.east_m, place[1] - piece.north_m
    along_m = piece.unit_east * x + piece.unit_north * y
    return bool(
        -piece.before_m + half_m - 1e-6 <= along_m <= piece.length_m + piece.after_m - half_m + 1e-6
    )


@given(
    polylines=LINES,
    place=PLACES,
    on_piece=st.one_of(st.none(), st.tuples(st.integers(0, 20), st.floats(-0.2, 1.2))),
    aside=st.floats(-1.3, 1.3),
    course=st.floats(0, 360),
    yaw=st.floats(-30, 30),
    speed=st.floats(0.1, 8.0),
)
def test_no_valve_is_open_off_every_line(
    polylines: list[Polyline],
    place: tuple[float, float],
    on_piece: tuple[int, float] | None,
    aside: float,
    course: float,
    yaw: float,
    speed: float,
) -> None:
    lines = planned(polylines)
    if lines is None:
        return
    if on_piece is not None:  # near a line, and along it: else hardly any state would open
        piece = lines.pieces[on_piece[0] % len(lines.pieces)]
        way = on_piece[1] * piece.length_m
        ue, un = piece.unit_east, piece.unit_north
        place = (piece.east_m + ue * way - un * aside, piece.north_m + un * way + ue * aside)
        course = math.degrees(math.atan2(ue, un)) + (course - 180.0) / 8.0
    state = flying(10.0, *place, **along(course, speed))
    state = replace(state, heading_deg=(course + yaw) % 360.0)
    routes = found(lines, state)
    sine, cosine = (f(math.radians(course + yaw)) for f in (math.sin, math.cos))
    velocity = np.array([state.velocity_east_m_s, state.velocity_north_m_s])
    for valve, route in zip(BOOM.valves, routes, strict=True):
        for at_s in np.linspace(9.701, 11.499, 40):
            if rate_at(route, at_s) is None:
                continue
            right = np.array([cosine, -sine])
            point = np.array(place) + velocity * (at_s - 10.0) + valve.right_m * right
            assert any(
                is_beside(
                    piece, point,
                    0.5 * valve.width_m
                    * abs(right[0] * piece.unit_east + right[1] * piece.unit_north),
                )
                and abs(
                    piece.unit_east * (place[1] - piece.north_m)
                    - piece.unit_north * (place[0] - piece.east_m)
                ) <= lines.aside_m
                for piece in lines.pieces
            )  # fmt: skip


@given(
    polylines=LINES,
    number=st.integers(0, 20),
    share=st.floats(0.0, 1.0),
    off=st.floats(-15.0, 15.0),
    leg=st.one_of(st.none(), st.tuples(PLACES, PLACES), st.floats(-0.5, 1.5)),
    age_s=st.one_of(st.floats(-40.0, 40.0), st.just(math.nan)),
)
def test_a_leg_only_takes_away_and_without_one_the_mission_opens_nothing(
    polylines: list[Polyline],
    number: int,
    share: float,
    off: float,
    leg: tuple[tuple[float, float], tuple[float, float]] | float | None,
    age_s: float,
) -> None:
    lines = planned(polylines)
    if lines is None:
        return
    piece = lines.pieces[number % len(lines.pieces)]
    ue, un, length = piece.unit_east, piece.unit_north, piece.length_m
    course = math.degrees(math.atan2(ue, un)) + off
    state = flying(
        10.0, piece.east_m + ue * share * length, piece.north_m + un * share * length,
        **along(course),
    )  # fmt: skip
    if isinstance(leg, float):  # along the line, from somewhere to its end
        begin = (piece.east_m + ue * leg * length, piece.north_m + un * leg * length)
        leg = (begin, (piece.east_m + ue * length, piece.north_m + un * length))
    way = None
    if leg is not None:
        way = MissionLeg(
            received_s=10.0 - age_s, from_east_m=leg[0][0], from_north_m=leg[0][1],
            to_east_m=leg[1][0], to_north_m=leg[1][1],
        )  # fmt: skip

    def flown(mode: str) -> set[Piece]:
        now = replace(state, mode=mode, mission_leg=way)
        return set(lines.flown(now, back_s=BACK_S, ahead_s=AHEAD_S, reach_m=BOOM.reach_m))

    assert flown("AUTO") == flown("MISSION")
    if way is None or not 0.0 <= state.time_s - way.received_s <= 31.0:
        assert not flown("AUTO")
    assert not flown("AUTO") or flown("GUIDED")


@given(
    start=st.floats(-40, 0), length=st.floats(5, 40), at_m=st.floats(-6, 50),
    aside=st.floats(-0.8, 0.8), is_back=st.booleans(), speed=st.floats(1.0, 8.0),
)  # fmt: skip
def test_on_a_line_its_whole_strip_is_sprayed_and_no_more(
    start: float, length: float, at_m: float, aside: float, is_back: bool, speed: float
) -> None:
    lines = Lines(polylines=(((start, 0.0), (start + length, 0.0)),))
    state = flying(10.0, start + at_m, aside, **along(270.0 if is_back else 90.0, speed))
    for route in found(lines, state):
        for at_s in np.linspace(9.701, 11.499, 40):
            east = state.east_m + state.velocity_east_m_s * (at_s - 10.0)
            if start + 1e-6 < east < start + length - 1e-6:
                assert rate_at(route, at_s) == 20.0
            elif not start - 1e-6 < east < start + length + 1e-6:
                assert rate_at(route, at_s) is None


@settings(max_examples=60)
@given(
    polylines=LINES,
    number=st.integers(0, 20),
    share=st.floats(0.0, 1.0),
    angle=st.floats(0, 360),
    shift=st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)),
)
def test_turning_the_world_turns_what_is_sprayed(
    polylines: list[Polyline],
    number: int,
    share: float,
    angle: float,
    shift: tuple[float, float],
) -> None:
    lines = planned(polylines)
    if lines is None:
        return
    piece = lines.pieces[number % len(lines.pieces)]
    if piece.length_m < 0.1:
        return
    place = (
        piece.east_m + piece.unit_east * share * piece.length_m,
        piece.north_m + piece.unit_north * share * piece.length_m,
    )
    course = math.degrees(math.atan2(piece.unit_east, piece.unit_north))
    here = found(lines, flying(10.0, *place, **along(course)))
    moved = Lines(
        polylines=tuple(
            tuple(turned(x, y, angle, shift) for x, y in polyline) for polyline in polylines
        )
    )
    state = flying(10.0, *turned(*place, angle, shift), **along(course + angle))
    there = found(moved, state, field(angle, shift))
    for one, other in zip(here, there, strict=True):
        for at_s in np.linspace(9.7, 11.5, 40):
            near = [abs(c.at_s - at_s) for c in (*one, *other)]
            if min(near) > 1e-4:  # the two may round a crossing differently
                assert rate_at(one, at_s) == rate_at(other, at_s)

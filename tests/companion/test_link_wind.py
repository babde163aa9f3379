"""A wind of exactly 0, or one that never changes in the air, is not known."""

from __future__ import annotations

import math

import pytest

from companion.core.types import Inhibit, Input, LandedReport, WindReport
from companion.link.component import STILL_MAX_S, Component, ComponentOptions, WindWatch
from tests.bench.gate_frames import STEP_S, Loop, Vehicle, long_setup
from tests.companion.component_peer import Peer

IN_AIR = LandedReport(received_s=0.0, in_air=True)


def known(watch: WindWatch, at_s: float, speed_m_s: float, **more: float) -> bool:
    report = WindReport(received_s=at_s, speed_m_s=speed_m_s, **more)
    found = watch.take(report)
    assert found in (report, WindReport(received_s=at_s, speed_m_s=None))
    return found == report


@pytest.mark.parametrize("calm", [0.0, -0.0])
def test_exactly_no_wind_is_not_known_anywhere(calm: float) -> None:
    watch = WindWatch()
    assert not known(watch, 1.0, calm, east_m_s=0.0, north_m_s=0.0)
    watch.take(IN_AIR)
    assert not known(watch, 2.0, calm)
    assert known(watch, 3.0, 0.01)


def test_a_wind_that_stands_still_in_the_air_is_not_known_until_it_moves() -> None:
    watch = WindWatch()
    watch.take(IN_AIR)
    assert known(watch, 1.0, 3.0)
    assert known(watch, 1.0 + STILL_MAX_S, 3.0)
    assert not known(watch, 1.1 + STILL_MAX_S, 3.0)
    assert known(watch, 12.0, 3.001)
    assert known(watch, 13.0, 3.001, east_m_s=-3.0, north_m_s=0.1)


def test_on_the_ground_a_wind_may_stand_still() -> None:
    watch = WindWatch()
    assert known(watch, 1.0, 3.0)
    assert known(watch, 100.0, 3.0)
    watch.take(IN_AIR)
    assert not known(watch, 101.0, 3.0)


def test_everything_else_passes_through() -> None:
    watch = WindWatch()
    for item in (IN_AIR, WindReport(received_s=1.0, speed_m_s=None)):
        assert watch.take(item) is item


@pytest.mark.parametrize("name", ["wind", "wind_cov"])
def test_the_component_hands_no_wind_on_that_is_none(name: str) -> None:
    peer = Peer()
    component = Component(ComponentOptions(), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    zeros = [0.0] * (2 if name == "wind" else 8)
    inputs = component.receive(peer.autopilot(name, 0, *zeros), 1.0)
    assert inputs == [WindReport(received_s=1.0, speed_m_s=None)]


@pytest.mark.parametrize("calm", [0.0, 3.0])
def test_nothing_opens_on_a_wind_that_is_none_where_one_is_required(calm: float) -> None:
    setup = long_setup(wind_required=True)
    loop, vehicle = Loop(setup), Vehicle(setup, begin_s=0.0)
    found: list[frozenset[Inhibit]] = []
    for number in range(round((STILL_MAX_S + 8.0) / STEP_S)):
        now_s = number * STEP_S
        data = b"".join(vehicle.said(number, now_s)) + (vehicle.enable() if number == 20 else b"")
        if number % 10 == 3:
            data += vehicle.pack(vehicle.sender.wind_encode(90.0, calm, 0.0))
        found.append(loop.turn(data, now_s).inhibits)
    assert found[-1] == {Inhibit.WIND_UNKNOWN}
    assert any(not inhibits for inhibits in found) is (calm > 0.0)
    assert loop.wrong == []


def test_a_wind_that_moves_stays_known() -> None:
    watch = WindWatch()
    items: list[Input] = [IN_AIR]
    items += [
        WindReport(received_s=0.5 * number, speed_m_s=3.0 + 0.01 * math.sin(number))
        for number in range(200)
    ]
    assert [watch.take(item) for item in items] == items

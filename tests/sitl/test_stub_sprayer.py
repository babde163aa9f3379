"""The sprayer behind the outputs delivers what the orders say, and knows both ways how much."""

from __future__ import annotations

import numpy as np
import pytest

from companion.errors import ConfigError
from sitl.stub.outputs import ServoOrder
from sitl.stub.sprayer import Sprayer, SprayerOptions


def half_open(sprayer: Sprayer, *, at_s: float, until_s: float) -> None:
    for channel in sprayer.options.channels:
        sprayer.take(ServoOrder(at_s=at_s, channel=channel, pulse_us=1500))
    step_s = 0.02
    for number in range(round((until_s - at_s) / step_s) + 1):
        sprayer.advance(at_s + number * step_s)
        sprayer.volume_l(at_s + number * step_s)


def test_half_open_valves_deliver_the_measured_flow() -> None:
    sprayer = Sprayer(SprayerOptions(), start_s=0.0)
    half_open(sprayer, at_s=1.0, until_s=21.0)
    # Wang et al. 2024, Table 2: 3.276 L/min at a duty of 0.5 with twelve nozzles.
    assert sprayer.volume_l(21.0) == pytest.approx(3.276 * 20.0 / 60.0, rel=0.02)


def test_the_litres_of_now_are_those_of_the_whole_flight() -> None:
    sprayer = Sprayer(SprayerOptions(seed=3), start_s=0.0)
    half_open(sprayer, at_s=1.0, until_s=8.0)
    whole_ml = sprayer.volume_ml(np.array([8.0])).sum()
    assert sprayer.volume_l(8.0) * 1000.0 == pytest.approx(whole_ml, rel=1e-9)


def test_orders_of_other_outputs_are_none_of_its() -> None:
    sprayer = Sprayer(SprayerOptions(), start_s=0.0)
    sprayer.take(ServoOrder(at_s=1.0, channel=5, pulse_us=2000))
    sprayer.advance(3.0)
    assert sprayer.volume_l(3.0) == 0.0
    assert not sprayer.orders


def test_a_configuration_with_another_number_of_valves_is_refused() -> None:
    with pytest.raises(ConfigError, match="wires 2 valves"):
        Sprayer(SprayerOptions(channels=(9, 10)), start_s=0.0)


def test_a_pump_behind_its_output_feeds_the_sections_that_are_open() -> None:
    options = SprayerOptions(profile="pump-sections", drive_channels=(15,))
    sprayer = Sprayer(options, start_s=0.0)
    for channel in options.channels:
        sprayer.take(ServoOrder(at_s=0.5, channel=channel, pulse_us=2000))
    for number in range(1501):
        now_s = 0.02 * number
        if number == 50:
            sprayer.take(ServoOrder(at_s=now_s, channel=15, pulse_us=1600))
        if number == 1000:
            sprayer.take(ServoOrder(at_s=now_s, channel=15, pulse_us=0))
        sprayer.advance(now_s)
        now_l = sprayer.volume_l(now_s)
    assert sprayer.volume_l(30.0) == pytest.approx(now_l)
    before, after, end = sprayer.volume_ml(np.array([10.0, 20.0, 30.0])).sum(axis=1)
    # The curve of the profile: 4.3 L/min at 0.6 of the pump's range; no pulse is a stop.
    assert after - before == pytest.approx(4.3 * 10.0 * 1000.0 / 60.0, rel=0.01)
    assert end - after < 0.2 * (after - before)
    assert [order.pulse_us for order in sprayer.motors.orders] == [1600, 0]


def test_a_configuration_with_other_motors_is_refused() -> None:
    with pytest.raises(ConfigError, match="wires 0 motors"):
        Sprayer(SprayerOptions(profile="pump-sections"), start_s=0.0)


def test_the_law_between_the_measured_points_can_be_chosen() -> None:
    """At a duty of 0.22, between two points of Table 2; a profile's own law is the smooth one."""
    litres = {}
    for law in (None, "smooth", "straight", "offset"):
        sprayer = Sprayer(SprayerOptions(flow_law=law), start_s=0.0)
        for channel in sprayer.options.channels:
            sprayer.take(ServoOrder(at_s=1.0, channel=channel, pulse_us=1220))
        sprayer.advance(11.0)
        litres[law] = sprayer.volume_l(11.0)
    assert litres[None] == litres["smooth"]
    assert len({round(value, 4) for value in litres.values()}) == 3

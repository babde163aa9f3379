"""What a vehicle says, as frames, closes the valves; what it no longer says does too."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.estimator import CONFIRM_COUNT, Track, estimate, observe
from companion.core.positions import LastPlace, look
from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    RangeReport,
    RcReport,
    SpeedReport,
    Telemetry,
    WindReport,
)
from companion.journal.codec import encode
from companion.link.component import Component, ComponentOptions
from companion.link.parameters import Parameters, known_parameters
from tests.bench.fuzz import fuzz
from tests.bench.gate_frames import STEP_S, Loop, Vehicle, long_setup

NAN, INF = math.nan, math.inf
BEGIN_S = 100.0
READY = 30  # steps until everything has been heard and a valve is open
SETUP = long_setup(length_m=500.0)
WITH_SWITCH = long_setup(length_m=500.0, rc_channel=7)
STRICT = long_setup(length_m=500.0, wind_required=True)


class Flight:
    """A healthy flight, step by step, whose messages can be left out or replaced."""

    def __init__(self, given: Any = SETUP) -> None:
        self.vehicle = Vehicle(given, begin_s=BEGIN_S)
        self.loop = Loop(given)
        self.number = 0
        self.encode = self.vehicle.sender

    @property
    def now_s(self) -> float:
        return BEGIN_S + self.number * STEP_S

    def step(
        self,
        more: bytes = b"",
        *,
        without: int | None = None,
        position: dict[str, Any] | None = None,
        enables: bool = False,
    ) -> Decision:
        frames = list(self.vehicle.said(self.number, self.now_s))
        if position is not None:
            frames[-1] = self.vehicle.position(self.now_s, **position)
        kept = [frame for frame in frames if int.from_bytes(frame[7:10], "little") != without]
        wish = self.vehicle.enable() if enables else b""
        decision = self.loop.turn(b"".join([*kept, wish, more]), self.now_s)
        self.number += 1
        return decision

    def ready(self) -> Flight:
        for _ in range(READY):
            decision = self.step(enables=self.number == 5)
        assert not decision.inhibits
        assert not decision.plan.is_off
        return self

    def says(self, name: str, *values: Any, **more: Any) -> bytes:
        return self.vehicle.pack(getattr(self.encode, f"{name}_encode")(*values, **more))


def ekf(flags: int = 831, velocity: float = 0.1, position: float = 0.1) -> tuple[Any, ...]:
    return ("ekf_status_report", flags, velocity, position, 0.1, 0.1, 0.0)


def estimator(flags: int = 831, velocity: float = 0.1, position: float = 0.1) -> tuple[Any, ...]:
    ratios = (velocity, position, 0.1, 0.1, 0.1, 0.1)
    return ("estimator_status", 0, flags, *ratios, 0.1, 0.1)


def distance(centimetres: int, orientation: int = 25, quality: int = 0) -> tuple[Any, ...]:
    numbers = (0, 10, 4000, centimetres, 0, 0, orientation, 0, 0.0, 0.0, [0.0] * 4, quality)
    return ("distance_sensor", *numbers)


def gnss(fix: int) -> tuple[Any, ...]:
    return ("gps_raw_int", 0, fix, 0, 0, 0, 80, 100, 500, 0, 20)


def rc(pulse_us: int) -> tuple[Any, ...]:
    return ("rc_channels", 0, 8, *([1500] * 6), pulse_us, 1500, *([65535] * 10), 255)


CLOSING: list[tuple[Inhibit, tuple[Any, ...]]] = [
    (Inhibit.NOT_ARMED, ("heartbeat", 2, 3, 1, 3, 4)),
    (Inhibit.WRONG_MODE, ("heartbeat", 2, 3, 129, 5, 4)),
    (Inhibit.WRONG_MODE, ("heartbeat", 2, 3, 129, 6, 4)),
    (Inhibit.WRONG_MODE, ("heartbeat", 2, 3, 129, 27, 4)),  # AUTO_RTL
    (Inhibit.WRONG_MODE, ("heartbeat", 2, 3, 129, 4_000_000_000, 4)),
    *((Inhibit.NOT_IN_AIR, ("extended_sys_state", 0, state)) for state in (0, 1, 3, 4, 255)),
    *((Inhibit.FIX_TOO_LOW, gnss(fix)) for fix in (0, 1, 2, 3, 4, 7, 8, 9, 255)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, ekf(831 & ~need)) for need in (2, 16)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, ekf(831 | refuse)) for refuse in (128, 1024, 32768)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, ekf(velocity=v)) for v in (0.8, 1.5, NAN, INF, -0.1)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, ekf(position=v)) for v in (0.8, 1.5, NAN, INF, -0.1)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, estimator(831 & ~need)) for need in (2, 16)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, estimator(flags)) for flags in (831 ^ 640, 831 | 1024)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, estimator(velocity=v)) for v in (1.0, NAN, -0.1)),
    *((Inhibit.ESTIMATOR_UNHEALTHY, estimator(position=v)) for v in (1.0, NAN, -0.1)),
    (Inhibit.SPEED_DISAGREES, ("vfr_hud", 0.0, 6.2, 90, 40, 60.0, 0.0)),
    (Inhibit.SPEED_DISAGREES, ("vfr_hud", 0.0, NAN, 90, 40, 60.0, 0.0)),
    (Inhibit.SPEED_DISAGREES, ("vfr_hud", 0.0, -5.0, 90, 40, 60.0, 0.0)),
    (Inhibit.WIND_ABOVE_MAX, ("wind", 0.0, 6.1, 0.0)),
    (Inhibit.WIND_ABOVE_MAX, ("wind_cov", 0, 5.0, -5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    (Inhibit.HEIGHT_BELOW_MIN, distance(90)),
    (Inhibit.HEIGHT_ABOVE_MAX, distance(1100)),
]


@pytest.mark.parametrize(("inhibit", "message"), CLOSING)
def test_a_message_closes_at_once(inhibit: Inhibit, message: tuple[Any, ...]) -> None:
    flight = Flight().ready()
    decision = flight.step(flight.says(*message))
    # Who disarms or leaves the mode has taken the consent back as well.
    assert decision.inhibits - {Inhibit.NOT_ENABLED} == {inhibit}
    assert decision.plan.is_off
    assert not any(flight.loop.follower.duty)
    assert not flight.loop.wrong


@pytest.mark.parametrize(
    "message",
    [
        gnss(5),
        ekf(velocity=0.79, position=0.79),
        estimator(velocity=0.99, position=0.99),
        ("vfr_hud", 0.0, 5.9, 90, 40, 60.0, 0.0),
        ("wind", 0.0, 5.9, 0.0),
        distance(300),
        distance(90, orientation=0),  # looks ahead
        distance(90, quality=1),  # says itself that it is invalid
        distance(5),  # below its own range
        distance(4000),  # sees nothing
        rc(1000),  # no switch is configured
    ],
)
def test_a_message_within_the_limits_closes_nothing(message: tuple[Any, ...]) -> None:
    flight = Flight().ready()
    decision = flight.step(flight.says(*message))
    assert not decision.inhibits
    assert not decision.plan.is_off


@pytest.mark.parametrize(
    ("change", "inhibit"),
    [
        ({"lat": 0, "lon": 0}, Inhibit.INVALID_POSITION),
        ({"lat": 0x7FFFFFFF}, Inhibit.INVALID_POSITION),
        ({"lon": -0x80000000}, Inhibit.INVALID_POSITION),
        ({"hdg": 65535}, Inhibit.HEADING_UNKNOWN),
        ({"hdg": 36500}, Inhibit.HEADING_UNKNOWN),
        ({"relative_alt": 990}, Inhibit.HEIGHT_BELOW_MIN),
        ({"relative_alt": 10_010}, Inhibit.HEIGHT_ABOVE_MAX),
        ({"vx": 0, "vy": 0}, Inhibit.POSITION_FROZEN),
    ],
)
def test_a_position_closes_at_once(change: dict[str, int], inhibit: Inhibit) -> None:
    flight = Flight().ready()
    decision = flight.step(position=change)
    assert inhibit in decision.inhibits
    assert len(decision.inhibits) == 1
    assert decision.plan.is_off


@pytest.mark.parametrize(
    ("without", "age_s", "inhibit"),
    [
        (0, 2.5, Inhibit.STALE_HEARTBEAT),
        (24, 5.0, Inhibit.FIX_TOO_LOW),
        (33, 0.8, Inhibit.STALE_POSITION),
        (65, 2.0, Inhibit.RC_SWITCH),
        (74, 1.0, Inhibit.SPEED_UNCHECKED),
        (193, 5.0, Inhibit.ESTIMATOR_UNHEALTHY),
        (245, 5.0, Inhibit.NOT_IN_AIR),
    ],
)
def test_a_message_that_no_longer_comes_closes(
    without: int, age_s: float, inhibit: Inhibit
) -> None:
    flight = Flight(WITH_SWITCH).ready()
    last_s = flight.now_s - STEP_S
    period_s = 1.0 if without == 0 else 0.5
    while not (decision := flight.step(without=without)).inhibits:
        assert flight.now_s < last_s + 10.0
    assert decision.inhibits == {inhibit}
    assert decision.plan.is_off
    assert age_s - period_s - STEP_S <= decision.now_s - last_s <= age_s + 2 * STEP_S


def test_wind_that_is_required_has_to_be_young() -> None:
    flight = Flight(STRICT)
    for _ in range(READY):
        decision = flight.step(enables=flight.number == 5)
    assert decision.inhibits == {Inhibit.WIND_UNKNOWN}
    assert not flight.step(flight.says("wind", 0.0, 3.0, 0.0)).inhibits
    found = [flight.step().inhibits for _ in range(110)]
    assert not any(found[:98])
    assert found[-1] == {Inhibit.WIND_UNKNOWN}


@pytest.mark.parametrize(
    "message",
    [("wind", 0.0, NAN, 0.0), ("wind_cov", 0, NAN, *([0.0] * 7)), ("wind", 0.0, INF, 0.0)],
)
def test_a_wind_that_is_no_number_is_unknown_and_calms_none_that_was_too_strong(
    message: tuple[Any, ...],
) -> None:
    flight = Flight(STRICT)
    for _ in range(READY):
        flight.step(enables=flight.number == 5)
    assert not flight.step(flight.says("wind", 0.0, 3.0, 0.0)).inhibits
    assert flight.step(flight.says(*message)).inhibits == {Inhibit.WIND_UNKNOWN}
    assert flight.step(flight.says("wind", 0.0, 8.0, 0.0)).inhibits == {Inhibit.WIND_ABOVE_MAX}
    assert flight.step(flight.says(*message)).inhibits == {Inhibit.WIND_ABOVE_MAX}


def test_wind_that_was_too_strong_and_is_no_longer_told_stays_too_strong() -> None:
    flight = Flight().ready()
    flight.step(flight.says("wind", 0.0, 8.0, 0.0))
    found = [flight.step().inhibits for _ in range(200)]
    assert found[-1] == {Inhibit.WIND_ABOVE_MAX}
    assert not flight.step(flight.says("wind", 0.0, 3.0, 0.0)).inhibits


def test_both_winds_blow_the_same_way() -> None:
    # From the west by ArduPilot is towards the east by PX4.
    flight, wanted = Flight().ready(), (3.0, 0.0)
    flight.step(flight.says("wind", 270.0, 3.0, 0.0))
    first = flight.loop.track.wind
    flight.step(flight.says("wind_cov", 0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    second = flight.loop.track.wind
    assert first is not None
    assert second is not None
    assert (first.east_m_s, first.north_m_s) == pytest.approx(wanted, abs=1e-6)
    assert (second.east_m_s, second.north_m_s) == pytest.approx(wanted, abs=1e-6)


def test_a_sensor_that_looks_down_counts_until_it_falls_silent() -> None:
    flight = Flight().ready()
    high = {"relative_alt": 30_000}  # the field lies higher than home
    assert not flight.step(flight.says(*distance(350)), position=high).inhibits
    found = [flight.step(position=high).inhibits for _ in range(22)]
    assert not any(found[:18])
    assert found[-1] == {Inhibit.HEIGHT_ABOVE_MAX}


# ---------------------------------------------------------------------------- the pilot takes over


def test_after_the_pilot_took_over_it_stays_closed_until_enabled_again() -> None:
    flight = Flight().ready()
    flight.step(flight.says("heartbeat", 2, 3, 129, 5, 4))
    flight.step(flight.says("heartbeat", 2, 3, 129, 3, 4))
    found = [flight.step() for _ in range(40)]
    assert all(decision.inhibits == {Inhibit.NOT_ENABLED} for decision in found[1:])
    assert all(decision.plan.is_off for decision in found)
    assert not flight.step(enables=True).inhibits


def switched(flight: Flight, *pulses: int) -> list[Decision]:
    """Step once for each pulse; the vehicle's own RC_CHANNELS say nothing meanwhile."""
    return [flight.step(flight.says(*rc(pulse)), without=65) for pulse in pulses]


@pytest.mark.parametrize("pulse_us", [0, 900, 1000, 1299, 65535, 2301])
def test_the_switch_closes_whoever_has_enabled(pulse_us: int) -> None:
    flight = Flight(WITH_SWITCH).ready()
    (decision,) = switched(flight, pulse_us)
    assert Inhibit.RC_SWITCH in decision.inhibits
    assert decision.plan.is_off
    # Enabling by another way does not get around it.
    flight.number += 1
    enabled = flight.step(flight.says(*rc(pulse_us)), enables=True, without=65)
    assert enabled.inhibits == {Inhibit.RC_SWITCH}


def test_a_switch_that_was_off_opens_by_its_own_edge_or_a_new_command() -> None:
    flight = Flight(WITH_SWITCH).ready()
    closed = switched(flight, 1000, 1500, 1500)
    assert closed[0].inhibits == {Inhibit.RC_SWITCH, Inhibit.NOT_ENABLED}
    assert closed[-1].inhibits == {Inhibit.NOT_ENABLED}
    assert not switched(flight, 1900)[-1].inhibits


def test_a_signal_that_was_lost_and_comes_back_enables_nothing() -> None:
    flight = Flight(WITH_SWITCH).ready()
    decisions = switched(flight, 0, 0, 1900, 1900)
    assert decisions[-1].inhibits == {Inhibit.NOT_ENABLED}


def test_settings_and_map_stay_as_they_are_while_armed() -> None:
    vehicle = Vehicle(SETUP, begin_s=BEGIN_S)
    parameters = Parameters(known_parameters({"lag.on_s": 0.1}))
    component = Component(ComponentOptions(), lambda frame: len(frame) > 0, parameters=parameters)
    station = vehicle.station

    def ask(armed: int) -> float:
        heartbeat = vehicle.pack(vehicle.sender.heartbeat_encode(2, 3, armed, 3, 4))
        message = station.param_set_encode(1, 191, b"SPR_LAG_ON", 0.2, 9)
        component.receive(heartbeat + bytes(message.pack(station)), 1.0)
        return parameters.get("SPR_LAG_ON", NAN)

    assert ask(armed=129) == 0.1
    assert ask(armed=1) == 0.2


# --------------------------------------------------------------------- positions that stand still


def frozen_at(flight: Flight) -> dict[str, Any]:
    """Return place and no velocity, as ArduPilot repeats them without an estimate."""
    latitude, longitude = SETUP.frame.to_geographic(5.0 * (flight.now_s - BEGIN_S), 3.0)
    place = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7)}
    return {**place, "vx": 0, "vy": 0, "vz": 0}


def test_a_stale_position_closes_at_its_first_message() -> None:
    flight = Flight().ready()
    stale = frozen_at(flight)
    found = [flight.step(position=stale) for _ in range(30)]  # all else says that it flies
    assert all(Inhibit.POSITION_FROZEN in decision.inhibits for decision in found)
    assert all(decision.plan.is_off for decision in found)
    after = [flight.step().inhibits for _ in range(CONFIRM_COUNT)]
    assert all(after[:-1])
    assert not after[-1]


def test_the_same_place_with_a_velocity_closes_as_soon_as_it_contradicts_itself() -> None:
    flight = Flight().ready()
    moving = {**frozen_at(flight), "vy": 500}
    first, second = flight.step(position=moving), flight.step(position=moving)
    assert not first.inhibits
    assert Inhibit.POSITION_FROZEN in second.inhibits
    assert second.plan.is_off


def at(boot_s: float, place: float, velocity: float | None) -> Telemetry:
    return Telemetry(
        received_s=boot_s, boot_s=boot_s, latitude_deg=36.0, longitude_deg=place,
        relative_altitude_m=3.5, velocity_north_m_s=0.0, velocity_east_m_s=velocity,
        velocity_down_m_s=0.0, heading_deg=90.0,
    )  # fmt: skip


def stands(*items: tuple[Telemetry, float | None, float | None]) -> list[bool]:
    stand: LastPlace | None = None
    found = []
    for item, expected_m_s, reported_m_s in items:
        stand = look(stand, item, expected_m_s=expected_m_s, reported_m_s=reported_m_s)
        found.append(stand.is_frozen)
    return found


def test_standing_still_for_ever_is_not_frozen() -> None:
    assert not any(stands(*((at(i * 0.1, 114.0, 0.0), 0.0, 0.0) for i in range(100))))


def test_the_second_speed_gives_a_frozen_place_away() -> None:
    found = stands(*((at(i * 0.1, 114.0, 0.0), 0.0, 5.0) for i in range(4)))
    assert found == [False, True, True, True]
    found = stands(*((at(i * 0.1, 114.0, None), None, 5.0) for i in range(4)))
    assert found == [False, True, True, True]


def test_a_frozen_place_stays_so_until_it_changes() -> None:
    later = [(at(0.1 + i * 0.1, 114.0, 0.0), 0.0, 0.0) for i in range(5)]
    assert stands((at(0.0, 113.9, 5.0), 5.0, 5.0), (at(0.1, 114.0, 0.0), 5.0, 5.0), *later[1:]) == [
        False,
        *([True] * 5),
    ]
    assert not stands((at(0.0, 113.9, 0.0), 5.0, None), (at(0.1, 114.0, 5.0), 5.0, None))[-1]


def test_what_is_no_number_gives_nothing_away() -> None:
    assert not any(stands(*((at(i * 0.1, 114.0, NAN), NAN, NAN) for i in range(4))))


@pytest.mark.parametrize("hz", [5.0, 10.0, 20.0, 50.0])
@pytest.mark.parametrize("brake_m_s2", [1.0, 2.5, 5.0])
def test_a_vehicle_that_brakes_stands_and_goes_on_is_never_frozen(
    hz: float, brake_m_s2: float
) -> None:
    track, east_m, speed = Track(), 0.0, 5.0
    for number in range(round(12.0 * hz)):
        now_s = number / hz
        if now_s > 3.0:
            going = now_s > 9.0
            speed = min(max(speed + (brake_m_s2 if going else -brake_m_s2) / hz, 0.0), 5.0)
        east_m += speed / hz
        latitude, longitude = SETUP.frame.to_geographic(east_m, 3.0)
        item = replace(
            at(now_s, round(longitude, 7), round(speed, 2)), latitude_deg=round(latitude, 7)
        )
        track = observe(track, SpeedReport(received_s=now_s, ground_speed_m_s=speed), SETUP)
        track = observe(track, item, SETUP)
        state = estimate(track, now_s)
        assert state is not None
        assert not state.position_frozen, (now_s, speed)


@pytest.mark.parametrize("noise_m_s", [0.02, 0.1, 0.29])
def test_a_vehicle_that_stands_is_not_frozen_by_the_noise_of_its_speed(noise_m_s: float) -> None:
    track = Track()
    for number in range(600):
        now_s = 0.1 * number
        track = observe(track, SpeedReport(received_s=now_s, ground_speed_m_s=noise_m_s), SETUP)
        track = observe(track, at(now_s, 114.5, noise_m_s), SETUP)
        state = estimate(track, now_s)
        assert state is not None
        assert not state.position_frozen, now_s


# --------------------------------------------------------------- no number, nothing, too old


def healthy(now_s: float) -> list[Input]:
    return [
        HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO"),
        GnssReport(received_s=now_s, fix=Fix.RTK_FIXED),
        EstimatorReport(received_s=now_s, healthy=True),
        LandedReport(received_s=now_s, in_air=True),
        WindReport(received_s=now_s, speed_m_s=3.0, east_m_s=3.0, north_m_s=0.0),
        RangeReport(received_s=now_s, height_m=3.5),
        RcReport(received_s=now_s, pulse_us=(1900,) * 8),
        OutputReport(received_s=now_s, healthy=True),
        SpeedReport(received_s=now_s, ground_speed_m_s=5.0),
    ]


def telemetry(now_s: float) -> Telemetry:
    latitude, longitude = SETUP.frame.to_geographic(5.0 * (now_s - 10.0), 3.0)
    return replace(
        at(now_s, longitude, 5.0), boot_s=now_s - 3.0, latitude_deg=latitude, received_s=now_s
    )


LIMITS = replace(
    SETUP.limits, wind_required=True, speed_check_required=True, rc_channel=7, wind_age_max_s=5.0
)
ALL_GATES = replace(SETUP, limits=LIMITS)
NOW_S = 12.0


def flown() -> Track:
    track = Track()
    wish = OperatorCommand(received_s=10.0, enable=True, source="command")
    for number in range(40):
        now_s = 10.0 + number * 0.05
        for item in [*healthy(now_s), *([wish] if number == 5 else []), telemetry(now_s)]:
            track = observe(track, item, ALL_GATES)
    return track


FLOWN = flown()


def decided(*items: Input, now_s: float = NOW_S) -> Decision:
    track = FLOWN
    for item in items:
        track = observe(track, item, ALL_GATES)
    return step(ALL_GATES, estimate(track, now_s), Memory(), now_s)[0]


def decisions(**receiver: float) -> list[str]:
    """Return a flight's decisions, whose receiver tells a stamp and a place of its own."""
    track, memory, made = Track(), Memory(), []
    wish = OperatorCommand(received_s=10.0, enable=True, source="command")
    for number in range(80):
        now_s = 10.0 + number * 0.05
        for item in [*healthy(now_s), *([wish] if number == 5 else []), telemetry(now_s)]:
            told = replace(item, **receiver) if isinstance(item, GnssReport) else item
            track = observe(track, told, ALL_GATES)
        decision, memory = step(ALL_GATES, estimate(track, now_s), memory, now_s)
        made.append(encode(decision))
    return made


def test_the_receivers_own_stamp_and_place_decide_nothing() -> None:
    """They show the delay that the autopilot assumes, which nobody measured."""
    without = decisions()
    assert any("TimedChange" in each for each in without)
    for value in (0.0, 36.0, 1e9, NAN, -INF):
        told = decisions(boot_s=value, latitude_deg=value, longitude_deg=value)
        assert told == without


# What no gate rests on: it is information, or it has another that stands in for it.
FREE = {
    ("Telemetry", "velocity_down_m_s"),
    ("GnssReport", "horizontal_accuracy_m"),
    ("HeartbeatReport", "autopilot"),
    ("OutputReport", "received_s"),  # told when it changes; it does not age
    ("RangeReport", "received_s"),  # the height above home stands in for it
    ("WindReport", "east_m_s"),  # the drift's, which checks them itself
    ("WindReport", "north_m_s"),
}
LAST = [*healthy(NOW_S), telemetry(NOW_S)]
NUMBERS = [
    (item, field.name)
    for item in LAST
    for field in fields(item)
    if isinstance(getattr(item, field.name), float)
    and (type(item).__name__, field.name) not in FREE
]


def test_the_case_that_the_next_start_from_is_open() -> None:
    decision = decided(*LAST)
    assert not decision.inhibits
    assert not decision.plan.is_off


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize(("item", "name"), NUMBERS, ids=lambda value: str(value)[:24])
def test_what_is_no_number_closes(item: Input, name: str, value: float) -> None:
    rest = [other for other in LAST if other is not item]
    decision = decided(*rest, replace(item, **{name: value}))  # type: ignore[arg-type]
    assert decision.inhibits
    assert decision.plan.is_off


NOTHING: list[Callable[[], Input]] = [
    lambda: replace(telemetry(NOW_S), heading_deg=None),
    lambda: LandedReport(received_s=NOW_S, in_air=None),
    lambda: RcReport(received_s=NOW_S, pulse_us=()),
    lambda: RcReport(received_s=NOW_S, pulse_us=(1900,) * 6),
    lambda: HeartbeatReport(received_s=NOW_S, autopilot="", armed=True, mode=""),
    lambda: OutputReport(received_s=NOW_S, healthy=False),
    lambda: SpeedReport(received_s=NOW_S, ground_speed_m_s=None),
    lambda: WindReport(received_s=NOW_S, speed_m_s=None),
]


@pytest.mark.parametrize("make", NOTHING)
def test_what_is_not_known_closes(make: Callable[[], Input]) -> None:
    item = make()
    decision = decided(*(other for other in LAST if type(other) is not type(item)), item)
    assert decision.inhibits
    assert decision.plan.is_off


@pytest.mark.parametrize("item", LAST, ids=lambda item: type(item).__name__)
def test_what_is_too_old_or_of_the_future_closes(item: Input) -> None:
    if isinstance(item, OutputReport | RangeReport):
        return  # told when it changes; stands in for the height above home
    rest = [other for other in LAST if type(other) is not type(item)]
    later_s = NOW_S + 5.2  # older than every limit
    fresh = [replace(other, received_s=later_s) for other in rest]
    decision = step(
        ALL_GATES, _estimated([*fresh, item], later_s, is_position=not isinstance(item, Telemetry)),
        Memory(), later_s,
    )[0]  # fmt: skip
    assert decision.inhibits
    assert decision.plan.is_off


def _estimated(items: list[Input], now_s: float, *, is_position: bool) -> Any:
    track = FLOWN
    if is_position:
        for number in range(40, 40 + round(5.2 / 0.05) + 1):
            track = observe(track, telemetry(10.0 + number * 0.05), ALL_GATES)
    for item in items:
        if not isinstance(item, Telemetry) or not is_position:
            track = observe(track, item, ALL_GATES)
    return estimate(track, now_s)


finite = st.floats(-1e12, 1e12)
anything = st.floats() | st.sampled_from([NAN, INF, -INF, 0.0, -0.0, 5e-324, 1e308])


@drawn(data=st.data())
def test_whatever_comes_in_nothing_raises_and_nothing_opens_under_a_reason(
    data: st.DataObject,
) -> None:
    track, memory, now_s = FLOWN, Memory(), NOW_S
    for _ in range(data.draw(st.integers(1, 6))):
        now_s += data.draw(st.floats(0.0, 1.0))
        item = data.draw(st.sampled_from([*healthy(now_s), telemetry(now_s)]))
        names = [f.name for f in fields(item) if isinstance(getattr(item, f.name), float)]
        changes = {name: data.draw(anything) for name in data.draw(st.sets(st.sampled_from(names)))}
        track = observe(track, replace(item, **changes), ALL_GATES)
        decision, memory = step(ALL_GATES, estimate(track, now_s), memory, now_s)
        assert decision.plan.is_off or not decision.inhibits
        assert all(0.0 <= change.duty <= 1.0 for change in decision.plan.changes)


def test_three_thousand_random_frames_open_nothing_that_should_be_closed() -> None:
    found = fuzz(3000, seed=7, watch_memory=False)
    assert not found["wrong"]
    assert found["open_steps"] > 50
    assert found["steps"] - found["open_steps"] > 200

"""The vehicle `flown` moves and errs as the logs that it is fitted to; the drawn one as ever."""

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ConfigError
from sitl.airframes import AIRFRAMES, DRAWN, FLOWN, airframe_of
from sitl.earth import Earth
from sitl.navigation import Navigation
from sitl.recorded import read_flight
from sitl.stub.server import StubOptions, noise_of
from sitl.stub.world import ARDUPILOT_NOISE, PX4_NOISE, Estimator, Pose, World
from sitl.vehicle import Leg, Route, Vehicle
from tests.sitl.stub_bench import HOME
from tools.studies.flown_vehicle import FITTED, figures_of, simulated

SEEDS = range(1, 7)
LEGS = tuple(
    Leg(east_m=east_m, north_m=north_m, speed_m_s=5.0)
    for east_m, north_m in ((0.0, 60.0), (6.0, 60.0), (6.0, 0.0), (30.0, 20.0))
)
ROUTE = Route(start_east_m=0.0, start_north_m=0.0, legs=LEGS)
# How far the mean of six flights may be from the nearest log's figure, as a factor: two flights of
# half a minute and one of a minute say no more.
WITHIN = 1.25
OF_LONG = ("across_time_s", "place_time_s", "pace_time_s")


@pytest.fixture(scope="module")
def flown() -> dict[str, float]:
    found = [figures_of(simulated(FLOWN, seed)) for seed in SEEDS]
    return {name: float(np.mean([one[name] for one in found])) for name in found[0]}


def test_every_figure_is_fitted(flown: dict[str, float]) -> None:
    assert set(flown) == set(FITTED)


@pytest.mark.parametrize("name", [n for n in FITTED if not n.endswith("white")])
def test_the_flown_vehicle_has_the_logs_figures(flown: dict[str, float], name: str) -> None:
    low, high = min(FITTED[name]), max(FITTED[name])
    within = 2.0 if name in OF_LONG else WITHIN
    assert low / within <= flown[name] <= high * within, (flown[name], FITTED[name])


@pytest.mark.parametrize("name", ["place_white", "pace_white"])
def test_its_errors_are_not_white(flown: dict[str, float], name: str) -> None:
    """The drawn vehicle's are, by nine tenths."""
    drawn = figures_of(simulated(DRAWN, 1))
    assert abs(flown[name]) < 0.15 < 0.8 < drawn[name]


@pytest.mark.skipif("VRSPRAY_REAL" not in os.environ, reason="no logs of real flights")
@pytest.mark.parametrize(("place", "name"), [(0, "q130"), (1, "q116")])
def test_the_table_is_the_logs_own(place: int, name: str) -> None:
    log = Path(os.environ["VRSPRAY_REAL"]) / "flights" / f"{name}.BIN"
    found = figures_of(read_flight(log, lambda mode: mode == "AUTO"))
    for figure, fitted in FITTED.items():
        assert found[figure] == pytest.approx(fitted[place], rel=0.02, abs=1e-3), figure


def test_the_drawn_vehicle_is_as_it_was_to_the_bit() -> None:
    """Its path, its messages and the stub's estimates, as before there was another."""
    seen = hashlib.sha256()
    for corners in ("stop", "ardupilot", "px4"):
        path = Vehicle(ROUTE, start_s=10.0, seed=3, corners=corners).fly_to_end()  # type: ignore[arg-type]
        for values in (
            path.time_s, path.east_m, path.north_m, path.velocity_east_m_s,
            path.velocity_north_m_s, path.heading_deg,
        ):  # fmt: skip
            seen.update(values.tobytes())
        told = Navigation(
            path, Earth(36.0, 114.5), seed=7, start_s=10.0, position_rate_hz=10.0, imu_rate_hz=20.0
        )
        seen.update(repr(told.advance(float(path.time_s[-1]))).encode())
    for noise in (ARDUPILOT_NOISE, PX4_NOISE):
        believed = Estimator(World(Pose(time_s=0.0, east_m=0.0, north_m=0.0)), noise, seed=5)
        seen.update(repr([believed.estimate(0.1 * k) for k in range(50)]).encode())
    assert seen.hexdigest() == "3bd713141851c781a97399f26c8198fdc5f58d397dbdaa26f3f015bd935fa768"


def test_the_stubs_estimate_drifts_as_the_airframe_says() -> None:
    """The velocity's error keeps its size, and half of it after a time constant times ln 2."""
    noise = FLOWN.noise
    still = World(Pose(time_s=0.0, east_m=0.0, north_m=0.0))
    believed = Estimator(still, noise, seed=1)
    told = [believed.estimate(0.1 * number) for number in range(40_000)]
    off = np.array([each.velocity_east_m_s for each in told])
    assert off.std() == pytest.approx(noise.velocity_drift_m_s, rel=0.1)
    steps = round(noise.velocity_drift_time_s * np.log(2.0) / 0.1)
    assert np.mean(off[steps:] * off[:-steps]) / off.var() == pytest.approx(0.5, abs=0.1)


def test_a_stub_of_the_flown_vehicle_tells_its_errors() -> None:
    assert noise_of(StubOptions(home=HOME, airframe=FLOWN)) == FLOWN.noise
    assert noise_of(StubOptions(home=HOME, airframe=FLOWN, autopilot="px4")) == FLOWN.noise
    assert noise_of(StubOptions(home=HOME, autopilot="px4")) == PX4_NOISE


def test_a_vehicle_that_there_is_not_is_named() -> None:
    with pytest.raises(ConfigError, match="--vehicle hovering: give one of drawn, flown"):
        airframe_of("hovering")
    assert airframe_of("flown", gust_m_s=2.0).gust_m_s == 2.0
    assert list(AIRFRAMES) == ["drawn", "flown"]

"""The offset by wind: what it is, when there is none, and what it may not open."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import shapely

from analysis.evaluation import evaluate
from companion.config import load
from companion.core.controller import Memory, step
from companion.core.crossings import Route, find_routes
from companion.core.estimator import Track, estimate, observe
from companion.core.options import drift
from companion.core.options.drift import Drift, fall_s
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.types import Inhibit, Input, VehicleState, WindReport
from companion.journal.codec import field_names_of, setup_to_json
from missions.maps.compiling import compiled_setup
from sitl.flight import FlightOptions, fly
from sitl.knowledge import lags as true_lags
from sitl.profile import load_profile
from sitl.trajectory import Leg
from sitl.trajectory import Route as SimulatedRoute
from sitl.vehicle import Vehicle
from tests.builders import SPRAYING, along, flying, position, setup
from tools.studies.droplets import TRUTHS, Air, fall, landed, law, shift_of, spectrum_um, with_wind

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "anyang" / "config.toml"
LAW = Drift(fall_s=0.8, forward_carry_m=0.2)
NAN = math.nan


def wind(east_m_s: float, north_m_s: float, *, at_s: float = 10.0) -> WindReport:
    return WindReport(
        received_s=at_s,
        speed_m_s=math.hypot(east_m_s, north_m_s),
        east_m_s=east_m_s,
        north_m_s=north_m_s,
    )


def blown(report: WindReport | None, law: Drift = LAW, now_s: float = 10.0) -> object:
    return drift.offset(law, replace(SPRAYING, wind=report), now_s)


# ------------------------------------------------------------------------------- the offset


def test_offset_is_wind_times_fall_and_the_carry_along_the_course() -> None:
    assert blown(wind(1.0, -0.5)) == pytest.approx((0.8 + 0.2, -0.4))
    north = replace(SPRAYING, wind=wind(1.0, -0.5), **along(0.0))  # type: ignore[arg-type]
    assert drift.offset(LAW, north, 10.0) == pytest.approx((0.8, -0.4 + 0.2))


def test_offset_does_not_grow_with_speed() -> None:
    slow, fast = (
        drift.offset(LAW, flying(10.0, 6.0, wind=wind(1.0, 1.0), **along(90.0, speed)), 10.0)
        for speed in (2.0, 12.0)
    )
    assert slow is not None
    assert slow == fast


@pytest.mark.parametrize(
    "report",
    [
        None,
        WindReport(received_s=10.0, speed_m_s=2.0),
        WindReport(received_s=10.0, speed_m_s=2.0, east_m_s=2.0),
        wind(NAN, 1.0),
        wind(1.0, math.inf),
        wind(1.0, 1.0, at_s=4.99),
        wind(1.0, 1.0, at_s=10.2),
        wind(1.0, 1.0, at_s=NAN),
        wind(4.3, 4.3),
    ],
    ids=["none", "no-direction", "half", "nan", "inf", "old", "future", "no-time", "too-much"],
)
def test_without_a_wind_to_trust_there_is_no_offset(report: WindReport | None) -> None:
    assert blown(wind(1.0, 1.0)) is not None
    assert blown(report) is None


def test_a_wind_is_used_up_to_its_age() -> None:
    assert blown(wind(1.0, 1.0, at_s=5.01)) is not None
    assert blown(wind(1.0, 1.0, at_s=10.05)) is not None  # jitter of two clocks


def test_the_operators_wind_goes_before_the_autopilots_and_does_not_age() -> None:
    given = replace(LAW, wind_m_s=(-1.0, 0.0), forward_carry_m=0.0)
    assert blown(wind(1.0, 0.0), given) == (-0.8, 0.0)
    assert blown(None, given, 1e6) == (-0.8, 0.0)
    assert blown(None, replace(given, wind_m_s=(-7.0, 0.0))) is None


def test_offset_is_held_to_its_limit_in_its_own_direction() -> None:
    east_m, north_m = drift.offset(
        replace(LAW, limit_m=1.0, forward_carry_m=0.0),
        replace(SPRAYING, wind=wind(3.0, 4.0)),
        10.0,
    ) or (0.0, 0.0)
    assert (east_m, north_m) == pytest.approx((0.6, 0.8))


def test_a_vehicle_that_stands_carries_nothing_forward() -> None:
    state = replace(SPRAYING, wind=wind(0.0, 1.0), velocity_east_m_s=0.4)
    assert drift.offset(LAW, state, 10.0) == (0.0, 0.8)


@pytest.mark.parametrize("name", ["fall_s", "forward_carry_m", "limit_m", "wind_age_max_s"])
def test_a_law_of_no_number_is_a_bug(name: str) -> None:
    for value in (NAN, -0.1, 1e9):
        with pytest.raises(ValueError, match=name):
            replace(LAW, **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("droplet_um", "still_s", "downwash_s"),
    [(100, 13.7, 1.45), (150, 7.0, 1.14), (200, 4.5, 0.94), (250, 3.2, 0.80), (400, 1.7, 0.56)],
)
def test_fall_is_that_of_a_ballistic_droplet(
    droplet_um: float, still_s: float, downwash_s: float
) -> None:
    assert fall_s(droplet_um, 3.5) == pytest.approx(still_s, rel=0.05)
    assert fall_s(droplet_um, 3.5, downwash_m_s=8.0) == pytest.approx(downwash_s, rel=0.03)


@pytest.mark.parametrize(
    "wrong", [{"droplet_um": NAN}, {"height_m": 0.0}, {"downwash_m_s": NAN}, {"exit_m_s": -1.0}]
)
def test_no_fall_of_what_is_no_droplet(wrong: dict[str, float]) -> None:
    given: dict[str, float] = {"droplet_um": 250.0, "height_m": 3.5}
    with pytest.raises(ValueError, match="no d"):
        fall_s(**(given | wrong))


# ------------------------------------------------------------------------------- in the core


def rates(route: Route) -> list[tuple[float, float | None]]:
    return [(crossing.at_s, crossing.rate_l_ha) for crossing in route]


def routes(state: VehicleState, offset_m: drift.Offset | None, **change: object) -> list[Route]:
    given = setup(**change)
    if offset_m is not None:
        state = drift.landed(state, offset_m)
    return list(
        find_routes(
            given.prescription, state, given.boom, back_s=0.3, ahead_s=2.0, border=given.border,
            border_buffer_m=given.border_buffer_m, across=given.across, drift_m=offset_m,
        )
    )  # fmt: skip


def test_a_boundary_is_crossed_when_the_liquid_lands_on_it() -> None:
    straight, ahead = (routes(flying(10.0, 10.0), d)[2] for d in (None, (1.5, 0.0)))
    assert [rate for _, rate in rates(straight)] == [20.0, 25.0]
    assert straight[1].at_s == pytest.approx(10.4)
    assert ahead[1].at_s == pytest.approx(10.4 - 1.5 / 5.0)
    assert ahead[1].speed_m_s == pytest.approx(straight[1].speed_m_s)


def test_wind_from_the_side_takes_the_next_plots_rate() -> None:
    zones = [
        Zone(name="s", polygon=shapely.box(0, 0, 48, 3), rate_l_ha=20.0),
        Zone(name="n", polygon=shapely.box(0, 3, 48, 6), rate_l_ha=25.0),
    ]
    field = Prescription(zones, boundary=shapely.box(0, -9, 48, 15))
    found = routes(flying(10.0, 20.0), (0.0, 1.0), prescription=field)
    assert [route[0].rate_l_ha for route in found] == [None, 25.0, 25.0, 25.0, 20.0, 20.0]


def shut(route: Route) -> list[tuple[float, float]]:
    """Return when a route is closed."""
    ends = [*(crossing.at_s for crossing in route[1:]), math.inf]
    return [
        (crossing.at_s, end)
        for crossing, end in zip(route, ends, strict=True)
        if crossing.rate_l_ha is None
    ]


NARROW = shapely.box(20.0, -1.0, 20.3, 7.0)


@pytest.mark.parametrize("along_m", [-1.9, -1.0, 1.0, 1.9])
def test_a_narrow_ditch_between_nozzle_and_landing_stays_dry(along_m: float) -> None:
    field = Prescription(
        [Zone(name="all", polygon=shapely.box(0, 0, 48, 6), rate_l_ha=20.0)],
        boundary=shapely.box(0, -5, 48, 11),
        exclusions=[NARROW],
    )
    state = flying(10.0, 16.0)
    for route in routes(state, (along_m, 0.0), prescription=field):
        ((begin_s, end_s),) = shut(route)
        # From the first of nozzle and landing at the ditch to the last beyond it, with 0.1 m each.
        assert begin_s == pytest.approx(10.0 + (20.0 - max(along_m, 0.0) - 0.1 - 16.0) / 5.0)
        assert end_s == pytest.approx(10.0 + (20.3 - min(along_m, 0.0) + 0.1 - 16.0) / 5.0)


def test_the_border_as_any_boundary_moves_with_the_landing() -> None:
    (begin_s, _), *_ = shut(routes(flying(10.0, 42.0), (1.0, 0.0), border="volume")[2])
    assert begin_s == pytest.approx(10.0 + (48.0 - 1.0 - 42.0) / 5.0)
    (strict_s, _), *_ = shut(routes(flying(10.0, 42.0), (-1.0, 0.0))[2])
    assert strict_s == pytest.approx(10.0 + (48.0 - 0.1 - 42.0) / 5.0)  # the nozzle's own


def test_a_change_of_the_wind_finds_the_routes_anew() -> None:
    given = setup(drift=LAW)
    memory = Memory()
    for now_s, report, place in (
        (10.0, wind(1.0, 0.0), 1.0),
        (10.05, wind(1.0, 0.0), 1.0),
        (10.1, wind(1.01, 0.0), 1.0),  # less than what counts
        (10.15, wind(-1.0, 0.0, at_s=10.15), -0.6),
        (10.2, None, None),
    ):
        state = flying(now_s, 6.0 + 5.0 * (now_s - 10.0), wind=report)
        _, memory = step(given, state, memory, now_s)
        assert memory.routes.drift_m == (None if place is None else pytest.approx((place, 0.0)))


def test_without_a_wind_the_law_changes_nothing() -> None:
    plain, lawful = setup(), setup(drift=LAW)
    one, two = Memory(), Memory()
    for number in range(60):
        now_s = 10.0 + number / 20
        state = flying(now_s, 6.0 + number / 4)
        left, one = step(plain, state, one, now_s)
        right, two = step(lawful, state, two, now_s)
        assert left == right
    windy = step(lawful, replace(state, wind=wind(1.0, 0.0, at_s=now_s)), two, now_s)[0]
    assert windy.plan != right.plan or windy.rate_l_ha != right.rate_l_ha


def test_a_wind_above_its_maximum_closes_and_is_not_corrected_for() -> None:
    state = replace(SPRAYING, wind=wind(5.0, 5.0), wind_m_s=math.hypot(5.0, 5.0))
    decision, _ = step(setup(drift=LAW, limits=Limits()), state, Memory(), 10.0)
    assert decision.inhibits == {Inhibit.WIND_ABOVE_MAX}


def test_the_state_has_a_wind_only_with_its_direction() -> None:
    given = setup()
    told: list[Input] = [position(10.0, 6.0, 3.0), WindReport(received_s=10.0, speed_m_s=2.0)]
    track = Track()
    for item in told:
        track = observe(track, item, given)
    state = estimate(track, 10.0)
    assert state is not None
    assert (state.wind_m_s, state.wind) == (2.0, None)
    state = estimate(observe(track, wind(1.0, 1.0), given), 10.0)
    assert state is not None
    assert state.wind == wind(1.0, 1.0)


# --------------------------------------------------------------------------- configuration


def test_it_is_off_unless_it_is_enabled() -> None:
    assert compiled_setup(load(EXAMPLE)).drift is None
    found = compiled_setup(load(EXAMPLE, overrides=["drift.enabled=true"])).drift
    assert found is not None
    assert found.fall_s == pytest.approx(0.79, abs=0.01)
    assert (found.limit_m, found.forward_carry_m, found.wind_m_s) == (2.0, 0.2, None)


def test_every_setting_reaches_the_law_under_its_own_name() -> None:
    values = {"fall_s": 0.5, "forward_carry_m": 0.31, "limit_m": 1.5, "wind_age_max_s": 3.0}
    overrides = [f"drift.{key}={value}" for key, value in values.items()]
    overrides += ["drift.enabled=true", "drift.wind=[2.0, 270.0]", "safety.wind_max_m_s=4.0"]
    found = load(EXAMPLE, overrides=overrides).drift_law()
    assert found is not None
    assert {key: getattr(found, key) for key in values} == values
    assert found.wind_max_m_s == 4.0
    assert found.wind_m_s == pytest.approx((2.0, 0.0))


def test_size_height_and_downwash_make_the_fall() -> None:
    base = load(EXAMPLE, overrides=["drift.enabled=true"]).drift_law()
    for override, longer in (
        ("drift.droplet_um=150", True),
        ("drift.downwash_m_s=12", False),
        ("boom.height_m=5.0", True),
    ):
        other = load(EXAMPLE, overrides=["drift.enabled=true", override]).drift_law()
        assert base is not None
        assert other is not None
        assert (other.fall_s > base.fall_s) is longer


def test_the_law_is_in_the_journals_set_up() -> None:
    text = setup_to_json(setup(drift=LAW))
    assert "fall_s" in field_names_of(text)["Drift"]
    assert '"drift": {"Drift": [0.8, 0.2, 2.0, 6.0, 5.0, null]}' in text


# -------------------------------------------------------------------------- the twin's drops


def test_the_twins_droplets_agree_with_the_model_where_they_should() -> None:
    one = fall(
        spectrum_um(250.0, 1), height_m=3.5, velocity_m_s=(0.0, 0.0),
        air=Air(downwash_m_s=8.0),
    )  # fmt: skip
    assert float(one.time_s[0]) == pytest.approx(fall_s(250.0, 3.5, downwash_m_s=8.0), rel=0.02)
    assert (float(one.east_m[0]), float(one.north_m[0])) == (0.0, 0.0)


def test_the_offset_takes_most_of_the_shift_away_where_the_sprayer_is_as_told() -> None:
    found = {truth.label: shift_of(truth) for truth in TRUTHS[:2]}
    for row in found.values():
        assert row.shift_m == pytest.approx(1.5, abs=0.1)
        assert row.left_m <= 0.12
        assert 0.06 <= row.carry_m <= 0.36  # what published droplets of this class have


def test_sizes_are_of_equal_volume_about_the_median() -> None:
    sizes = spectrum_um(200.0, 5)
    assert sizes[2] == pytest.approx(200.0)
    assert sizes[0] * sizes[4] == pytest.approx(200.0**2)


def test_the_controllers_wind_arrives_twice_a_second() -> None:
    items: list[Input] = [WindReport(received_s=t / 10, speed_m_s=0.0) for t in range(20)]

    def stream() -> Iterator[Input]:
        yield from items

    told = [item for item in with_wind(stream(), (1.0, 0.0)) if item not in items]
    assert [item.received_s for item in told] == [0.0, 0.5, 1.0, 1.5]
    assert law().fall_s == pytest.approx(0.79, abs=0.01)


@pytest.mark.parametrize(("sign", "course_deg"), [(1.0, 90.0), (1.0, 270.0)])
def test_in_wind_along_a_pass_liquid_lands_on_the_boundary_with_the_offset_only(
    sign: float, course_deg: float
) -> None:
    blows, ahead = (2.0 * sign, 0.0), (5.0 if course_deg == 90.0 else -5.0, 0.0)
    profile = load_profile("wang-2024")
    start, end = (-25.0, 73.0) if ahead[0] > 0.0 else (73.0, -25.0)
    way = SimulatedRoute(
        start_east_m=start,
        start_north_m=3.0,
        legs=(Leg(east_m=end, north_m=3.0, speed_m_s=5.0),),
    )
    path = Vehicle(way, start_s=100.0, seed=1, gust_m_s=0.0).fly_to_end()
    ways = [TRUTHS[0].landing(blows, (speed, 0.0)) for speed in (5.0, -5.0)]
    lags = []
    for given in (None, law()):
        flight = fly(
            setup(lag=true_lags(profile), drift=given),
            path,
            profile,
            FlightOptions(fidelity="averaged", noise=False, scatter=False),
            speed_m_s=5.0,
            disturb=lambda items: with_wind(items, blows),
        )
        found = evaluate(landed(flight.record, ways, (5.0, 0.0)))
        assert found.off_target_ml == 0.0 or given is None
        assert found.lag_distance_m.count >= 12
        lags.append(found.lag_distance_m.max_abs or 0.0)
    assert lags[0] >= 1.2
    assert lags[1] <= 0.15

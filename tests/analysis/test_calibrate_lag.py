from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from analysis.calibrate_cli import TooFewStepsError, lag_result, refusal, settings
from analysis.calibration.identify import identify, jackknife, mean_of
from analysis.calibration.steps import FlowRecord, Kind, Reject, find_steps, is_trim, record_of
from analysis.evaluation import evaluate
from companion.cli.app import execute
from companion.config import load
from companion.core.schedule import LagModel
from companion.core.types import Decision, FlowReport, SprayPlan, TimedChange
from companion.errors import ConfigError
from companion.journal.journal import Journal
from missions.maps.compiling import compiled_setup
from sitl.anyang import demo_setup
from sitl.calibration_mission import make_layout, write_calibration
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.routes import read_route
from sitl.vehicle import Vehicle
from tests.analysis.calibration_bench import TRUE_S, Bench, metered

ANYANG = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
ORCHARD = ANYANG.parents[1] / "orchard" / "config.toml"
BENCH = Bench()


def lags(record: FlowRecord) -> dict[str, float]:
    return {kind.value: estimate.value for kind, estimate in identify(record).lags.items()}


def plan(
    sequence: int, duty: float, *changes: tuple[float, float], issued_s: float, lease_s: float = 9.0
) -> Decision:
    return Decision(
        now_s=issued_s,
        state=None,
        inhibits=frozenset(),
        plan=SprayPlan(
            sequence=sequence,
            issued_s=issued_s,
            duty=(duty,) * 6,
            changes=tuple(TimedChange(at_s=at_s, valve=0, duty=after) for at_s, after in changes),
            lease_until_s=issued_s + lease_s,
        ),
        rate_l_ha=(None,) * 6,
        target_flow_l_min=0.0,
        flow_l_min=0.0,
    )


# ------------------------------------------------------------------------------- from a journal


def test_a_change_that_a_newer_plan_took_back_was_never_ordered() -> None:
    decisions = [
        plan(1, 0.5, (2.0, 0.8), issued_s=1.0),
        plan(2, 0.5, (2.5, 0.9), issued_s=1.5),
        plan(3, 0.5, issued_s=3.0),
    ]
    orders = record_of(decisions, demo_setup(5.0)).orders
    of_first = [(order.at_s, order.after) for order in orders if order.valve == 0]
    assert of_first == [(1.0, 0.5), (2.5, 0.9), (3.0, 0.5), (12.0, 0.0)]


def test_the_end_of_a_lease_is_an_order_to_close() -> None:
    decisions = [plan(1, 0.5, issued_s=1.0, lease_s=0.3), plan(2, 0.0, issued_s=5.0)]
    orders = record_of(decisions, demo_setup(5.0)).orders
    assert [(order.at_s, order.after) for order in orders if order.valve == 3] == [
        (1.0, 0.5),
        (1.3, 0.0),
    ]


def test_readings_that_repeat_or_are_no_number_are_left_out() -> None:
    reports = [(0.0, 1.0), (0.0, 1.0), (0.1, float("nan")), (0.2, 2.0)]
    items = [FlowReport(received_s=at_s, volume_ml=ml) for at_s, ml in reports]
    record = record_of(items, demo_setup(5.0))
    assert record.time_s.tolist() == [0.0, 0.2]
    assert record.volume_ml.tolist() == [1.0, 2.0]


# -------------------------------------------------------------------------------------- estimate


def test_all_four_lags_come_out_of_exact_readings() -> None:
    assert lags(BENCH.record()) == pytest.approx(TRUE_S, abs=5e-5)


def test_a_turbines_pulses_cost_less_than_a_millisecond() -> None:
    record = Bench(pulse_ml=1.0 / 4.6, gain=1.03, offset_ml=500.0).record()
    assert lags(record) == pytest.approx(TRUE_S, abs=1e-3)


def test_the_meters_own_delay_is_taken_off() -> None:
    late = Bench(meter_lag_s=0.025).record()
    found = identify(late, meter_lag_s=0.025).lags[Kind.ON].value
    assert found == pytest.approx(TRUE_S["on"], abs=5e-5)
    assert identify(late).lags[Kind.ON].value == pytest.approx(TRUE_S["on"] + 0.024, abs=5e-5)


def test_lags_are_those_at_the_output() -> None:
    record = BENCH.record()
    shifted = identify(replace(record, lag=replace(record.lag, output_s=0.012)))
    assert shifted.lags[Kind.UP].value == pytest.approx(TRUE_S["up"] - 0.012, abs=5e-5)
    assert settings(shifted)["output_s"] == 0.012


def test_valves_that_cross_one_after_the_other_have_the_mean_of_their_orders() -> None:
    assert lags(Bench(spread_s=0.06, valves=4).record()) == pytest.approx(TRUE_S, abs=5e-5)


def test_trims_for_the_speed_are_taken_out_of_the_volume() -> None:
    trims = ((0.45, 0.03), (0.8, -0.02), (1.3, 0.02))
    record = Bench(trims=trims).record()
    assert any(is_trim(order) for order in record.orders)
    # Trims up and down are taken to act after the same time, which here differ by 23 ms.
    assert lags(record) == pytest.approx(TRUE_S, abs=5e-4)
    untrimmed = tuple(order for order in record.orders if not is_trim(order))
    assert lags(replace(record, orders=untrimmed)) != pytest.approx(TRUE_S, abs=2e-3)


def test_first_and_last_flow_are_bounded_from_the_safe_side() -> None:
    record = Bench(pulse_ml=1.0 / 4.6).record()
    chosen = settings(identify(record))
    ramp_begins_s = TRUE_S["on"] - 0.015
    ramp_ends_s = TRUE_S["off"] + 0.015
    # Half an off-time of the largest duty is taken off: this sprayer has no pulses.
    assert ramp_begins_s - 0.04 < chosen["on_start_s"] <= ramp_begins_s
    assert ramp_ends_s <= chosen["off_end_s"] < ramp_ends_s + 0.02


def test_what_is_pasted_is_a_lag_model() -> None:
    chosen = settings(identify(BENCH.record()))
    assert LagModel(**chosen).on_s == chosen["on_s"]


# ------------------------------------------------------------------------------------- rejection


def test_steps_too_near_to_each_other_are_not_used() -> None:
    found = identify(Bench(dwell_s=0.8).record())
    assert found.rejected[Reject.NEAR] >= 46
    assert len(found.missing) == 4


def disturbed(at_s: float, change: Callable[[float], float]) -> FlowRecord:
    """Return the bench's record, metered volume changed from a time on."""
    record = BENCH.record()
    late = record.time_s >= at_s
    volume_ml = record.volume_ml.copy()
    volume_ml[late] = [change(ml) for ml in volume_ml[late]]
    return metered(record, volume_ml)


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (disturbed(16.2, lambda ml: ml + 12.0), Reject.UNSTEADY),
        (disturbed(16.2, lambda ml: ml - 40.0), Reject.NO_METER),
    ],
)
def test_a_disturbed_step_is_rejected_and_the_others_are_not_moved(
    record: FlowRecord, reason: Reject
) -> None:
    found = identify(record)
    assert 1 <= found.rejected[reason] <= 3
    assert lags(record) == pytest.approx(TRUE_S, abs=1e-4)


def test_a_gap_of_the_meter_rejects_the_steps_around_it() -> None:
    record = BENCH.record()
    kept = (record.time_s < 16.0) | (record.time_s > 16.5)
    gap = replace(record, time_s=record.time_s[kept], volume_ml=record.volume_ml[kept])
    assert 1 <= identify(gap).rejected[Reject.NO_METER] <= 3
    assert lags(gap) == pytest.approx(TRUE_S, abs=1e-4)


def test_a_step_that_came_late_is_told_from_the_others() -> None:
    record = BENCH.record()
    orders = tuple(
        replace(order, at_s=order.at_s - 0.05) if 14.9 < order.at_s < 15.1 else order
        for order in record.orders
    )
    found = identify(replace(record, orders=orders))
    assert found.rejected == {Reject.ODD: 1}
    assert found.lags[Kind.UP].count == 11


def test_valves_that_change_in_different_ways_are_no_step() -> None:
    record = BENCH.record()
    orders = tuple(
        replace(order, after=0.0, after_ml_s=0.0)
        if 14.9 < order.at_s < 15.1 and order.valve == 1
        else order
        for order in record.orders
    )
    assert find_steps(replace(record, orders=orders))[1][Reject.MIXED] == 1


# --------------------------------------------------------------------------------------- refusal


def test_too_few_steps_are_refused_by_name() -> None:
    found = identify(Bench(cycles=2, dwell_s=2.0).record())
    assert set(found.missing) == set(Kind)
    why = refusal(found)
    assert why is not None
    assert "on 4" in why and "needs 6" in why and "\n" not in why
    with pytest.raises(TooFewStepsError, match="too few good steps"):
        lag_result(found)


def test_a_meter_that_stands_still_answers_nothing() -> None:
    record = BENCH.record()
    found = identify(metered(record, np.zeros(len(record.time_s))))
    assert not found.lags
    assert found.rejected[Reject.NOT_FOLLOWED] == 48


def test_no_meter_at_all_answers_nothing() -> None:
    record = BENCH.record()
    none = np.zeros(0)
    found = identify(replace(record, time_s=none, volume_ml=none))
    assert not found.lags
    assert found.rejected[Reject.NO_METER] == 48


# ------------------------------------------------------------------------------------- intervals


def test_an_interval_is_students() -> None:
    found = mean_of([1.0, 2.0, 3.0, 4.0], [0.0] * 4)
    assert found.value == 2.5
    assert found.high - 2.5 == pytest.approx(3.182 * 1.290994 / 2.0, abs=1e-3)
    with pytest.raises(ValueError, match="two"):
        mean_of([1.0], [0.1])


def test_an_interval_is_that_of_the_fits_where_the_scatter_is_no_more() -> None:
    found = mean_of([1.0, 2.0, 3.0, 4.0], [1.2] * 4)
    assert found.high - 2.5 == pytest.approx(1.96 * 1.2 / 2.0, abs=1e-3)


def test_the_jackknife_of_a_mean_is_the_means_interval() -> None:
    values = [1.0, 2.0, 4.0, 4.5, 7.0]
    found = jackknife(lambda chosen: sum(chosen) / len(chosen), values)
    assert found.high == pytest.approx(mean_of(values, [0.0] * 5).high)


# --------------------------------------------------------------------------------------- mission


@pytest.mark.parametrize("config", [ANYANG, ORCHARD])
def test_the_mission_has_twelve_changes_of_each_kind(config: Path) -> None:
    layout = make_layout(load(config))
    kinds = {"on": 0, "off": 0, "up": 0, "down": 0}
    for flows in layout.passes:
        for before, after in pairwise(flows):
            kind = "on" if before == 0.0 else "off" if after == 0.0 else ""
            kinds[kind or ("up" if after > before else "down")] += 1
    assert kinds == {"on": 12, "off": 12, "up": 12, "down": 12}
    assert layout.strip_m / layout.speed_m_s > 1.5 + 0.3


@pytest.mark.parametrize("suffix", [".plan", ".waypoints"])
def test_the_mission_can_be_flown_where_it_was_asked_for(tmp_path: Path, suffix: str) -> None:
    written = write_calibration(
        ANYANG, tmp_path / f"cal{suffix}", origin=(48.1, 11.5), heading_deg=30.0
    )
    setup = compiled_setup(load(written.config))
    route = read_route(written.mission, setup.frame, speed_m_s=None, default_speed_m_s=1.0)
    assert setup.frame.latitude_deg == pytest.approx(48.1, abs=0.002)
    assert {leg.speed_m_s for leg in route.legs} == {5.0}
    # Along each pass every strip lies under the whole boom.
    first = route.legs[0]
    share = [i / 200 for i in range(201)]
    rates = {
        setup.prescription.rate_at(
            route.start_east_m + s * (first.east_m - route.start_east_m),
            route.start_north_m + s * (first.north_m - route.start_north_m),
        )
        for s in share
    }
    assert len({rate for rate in rates if rate}) == 2


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--out", "x.txt"), "name it .plan or .waypoints"),
        (("--out", "x.plan", "--origin", "here"), "LATITUDE,LONGITUDE"),
        (("--out", "x.plan", "--origin", "95,10"), "not a position"),
        (("--out", "no/such/folder/x.plan"), "cannot be written"),
        (("--out", "x.plan", "--heading-deg", "nan"), "degrees clockwise"),
    ],
)
def test_a_mission_that_cannot_be_made_is_refused_in_one_line(
    options: tuple[str, ...],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert execute(["calibrate", "mission", "--config", str(ANYANG), *options]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def of_a_field(folder: Path) -> Path:
    """A configuration as after a season: lines of a plan, coverage, exclusions, limits, a tank."""
    # Across the first strip of a flight that begins at 48.1, 11.5, where nothing is sprayed.
    line = {"type": "LineString", "coordinates": [[11.49996, 48.10002], [11.50004, 48.10002]]}
    feature = {"type": "Feature", "geometry": line, "properties": {"kind": "spray"}}
    text = json.dumps({"type": "FeatureCollection", "features": [feature]})
    (folder / "field.lines.geojson").write_text(text)
    (folder / "limits.toml").write_text(
        'version = 1\ntitle = "permit"\nrate_max_l_ha = 1.0\nhours = ["00:00-00:01"]\n'
        'utc_offset = "+00:00"\n'
    )
    path = folder / "season.toml"
    path.write_text(
        ANYANG.read_text().replace(
            "[boom]", '[coverage]\nswitch_off_percent = 50\n\n[limits]\nfile = "limits.toml"\n\n'
            '[product]\nname = "X"\nrate_max_l_ha = 2.0\n\n[boom]'
        ).replace("[mission]\n", '[mission]\nlines = "field.lines.geojson"\n', 1)
    )  # fmt: skip
    assert "field.lines" in path.read_text()
    return path


def test_a_season_in_the_field_leaves_the_calibration_flight_its_water(tmp_path: Path) -> None:
    written = write_calibration(of_a_field(tmp_path), tmp_path / "cal.plan", origin=(48.1, 11.5))
    config = load(written.config)
    setup = compiled_setup(config)
    assert config.mission is not None and config.mission.lines is None
    assert (setup.lines, setup.overlap, config.label, config.rate_max_l_ha()) == (None,) * 4
    route = read_route(written.mission, setup.frame, speed_m_s=None, default_speed_m_s=5.0)
    trajectory = Vehicle(replace(route, legs=route.legs[:1]), start_s=0.0, seed=5).fly_to_end()
    options = FlightOptions(fidelity="averaged", output="servo", seed=5)
    flown = fly(setup, trajectory, load_profile("wang-2024"), options, speed_m_s=5.0)
    share = 1.0 / len(written.layout.passes)
    assert evaluate(flown.record).applied_ml == pytest.approx(
        1000.0 * share * written.layout.volume_l, rel=0.1
    )


def test_a_calibration_flight_that_would_spray_nothing_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it was before: the lines of the field stay, and close every valve."""
    path = of_a_field(tmp_path)
    monkeypatch.setattr("sitl.calibration_mission.LINES", "none")
    with pytest.raises(ConfigError, match="can open no valve on this map, because no line of"):
        write_calibration(path, tmp_path / "cal.plan", origin=(48.1, 11.5), heading_deg=0.0)
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "field.lines.geojson", "limits.toml", "season.toml",
    ]  # fmt: skip


# --------------------------------------------------------------------------------- on the twin


@pytest.fixture(scope="module")
def journals(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A calibration flight's journal on the twin, and one of its first pass only."""
    folder = tmp_path_factory.mktemp("calibration")
    written = write_calibration(ANYANG, folder / "cal.plan")
    setup = compiled_setup(load(written.config))
    route = read_route(written.mission, setup.frame, speed_m_s=None, default_speed_m_s=5.0)
    options = FlightOptions(fidelity="averaged", output="servo", seed=5, meter_rate_hz=50.0)
    made = []
    for legs in (route.legs, route.legs[:1]):
        trajectory = Vehicle(replace(route, legs=legs), start_s=0.0, seed=5).fly_to_end()
        with Journal.create(
            folder, setup=setup, setup_text={}, started_s=0.0, waits=True
        ) as journal:
            fly(
                setup,
                trajectory,
                load_profile("wang-2024"),
                options,
                speed_m_s=5.0,
                observer=journal.record_decision,
                on_input=partial(_record_meter, journal),
            )
            made.append(journal.path)
    return made[0], made[1]


def _record_meter(journal: Journal, item: object) -> None:
    if isinstance(item, FlowReport):
        journal.record_input(item)


def test_a_flights_journal_gives_the_twins_lags(
    journals: tuple[Path, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    picture = tmp_path / "lags.png"
    arguments = ["calibrate", "lag", str(journals[0]), "--json", "--plot", str(picture)]
    assert execute(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    nominal_s = load_profile("wang-2024").mean_lag_s
    for key in ("on_s", "off_s", "up_s", "down_s"):
        assert result[key]["count"] >= 10
        assert result[key]["low"] < result[key]["value"] < result[key]["high"]
        # The valves' own mean scatters by 2 ms, the 12 ms of the output path are configured.
        assert result[key]["value"] == pytest.approx(nominal_s, abs=0.010)
    assert result["on_start_s"]["low"] < result["on_s"]["value"] < result["off_end_s"]["high"]
    assert picture.stat().st_size > 1000


def test_the_answer_for_a_person_can_be_pasted(
    journals: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["calibrate", "lag", str(journals[0])]) == 0
    text = capsys.readouterr().out
    assert "12 steps" in text
    assert "[lag]\non_s = 0.1" in text


def test_half_a_flight_is_refused_with_exit_1(
    journals: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["calibrate", "lag", str(journals[1]), "--json"]) == 1
    said = capsys.readouterr()
    assert "too few good steps" in json.loads(said.out)["error"]
    assert said.err.count("\n") == 1


def test_a_journal_without_a_meter_is_refused_with_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Journal.create(
        tmp_path, setup=demo_setup(5.0), setup_text={}, started_s=0.0, waits=True
    ) as journal:
        journal.record_decision(plan(1, 0.5, issued_s=1.0))
        path = journal.path
    assert execute(["calibrate", "lag", str(path)]) == 2
    error = capsys.readouterr().err
    assert "no flow meter" in error
    assert "[flow_meter]" in error and "sitl fly --meter-rate-hz" in error

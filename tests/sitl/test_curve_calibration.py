"""`calibrate curve` on the twin: the weighed flows stand, and between them it is what flows."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import analysis.calibration.curve as curves_module
from analysis.calibrate_curve import (
    measured_records,
    read_records,
    weighed_sets,
    write_records,
)
from analysis.calibrate_valves import Measured
from analysis.calibration.curve import (
    CurveCourseError,
    SetCurve,
    Weighed,
    curve_course,
    identify_curve,
)
from analysis.calibration.steps import CarriedOut, FlowRecord, Order
from analysis.write_back import write_back
from companion.cli.app import execute
from companion.config import load
from companion.core.setup import Setup
from companion.ground.shell import GroundOutcome
from companion.ground.work import PIECE_MAX_S, GroundReason, GroundTask
from sitl.profile import FLOW_LAWS, TYPICAL, FlowLaw, PlantProfile, load_profile
from sitl.valve_calibration import calibrate_curves, recorded_curve, with_curves
from tests.bench.sprayers import options_of, sprayer_setup

ANYANG = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"
NAMES = ("1", "2", "3", "4", "5", "6")


@pytest.fixture(scope="module")
def setup() -> Setup:
    return sprayer_setup("wang-2024", "gpio")


@pytest.fixture(scope="module")
def weighed(setup: Setup) -> Weighed:
    return of_set(setup)


def of_set(setup: Setup) -> Weighed:
    (nozzles,) = setup.nozzle_sets
    return Weighed(
        valves=nozzles.valves, duty=nozzles.curve.duty, flow_l_min=nozzles.curve.flow_l_min
    )


@pytest.fixture(scope="module")
def records(setup: Setup, weighed: Weighed) -> list[FlowRecord]:
    course = curve_course(weighed, setup.pwm, setup.lag)
    return recorded_curve(setup, load_profile("wang-2024"), options_of("gpio", 5), [course])[0][0]


def on_twin(setup: Setup, profile: PlantProfile, seed: int) -> SetCurve:
    """Return the curve of the one set, with what the twin draws by the seed."""
    options = replace(options_of("gpio", seed), flow_law=profile.flow_law)
    ((found,), _) = calibrate_curves(setup, profile, options)
    return found


def perfect_meter(profile: PlantProfile) -> PlantProfile:
    return replace(profile, meter=replace(profile.meter, gain_spread=0.0, noise=0.0))


@pytest.mark.parametrize("law", FLOW_LAWS)
def test_between_the_weighed_duties_it_is_what_flows(setup: Setup, law: FlowLaw) -> None:
    profile = replace(load_profile("wang-2024"), flow_law=law)
    (measured,) = (each for each in profile.nozzle_sets if len(each.valves) == 6)
    duties = np.array(measured.duty)
    truth = measured.flows_l_min(law, duties).tolist()
    # A bucket finds what flows, by whatever law.
    nozzles = replace(
        setup.nozzle_sets[0],
        curve=replace(setup.nozzle_sets[0].curve, flow_l_min=tuple(truth)),
    )
    for seed in (1, 2):
        found = on_twin(replace(setup, nozzle_sets=(nozzles,)), profile, seed)
        between = [point for point in found.points if not point.is_weighed]
        assert len(between) == 10
        flows = measured.flows_l_min(law, np.array([point.duty for point in between]))
        for point, flow in zip(between, flows.tolist(), strict=True):
            assert point.flow_l_min == pytest.approx(flow, rel=0.006)
            assert 0.001 < (point.high - point.low) / flow < 0.02
        held = [p.low <= f <= p.high for p, f in zip(between, flows.tolist(), strict=True)]
        assert np.mean(held) >= 0.8


def test_a_weighed_flow_stands_to_the_last_digit_and_the_flow_rises(
    records: list[FlowRecord], weighed: Weighed
) -> None:
    found = identify_curve(records, weighed)
    kept = {point.duty: point for point in found.points if point.is_weighed}
    assert tuple(kept) == weighed.duty == found.weighed_duty
    assert tuple(point.flow_l_min for point in kept.values()) == weighed.flow_l_min
    assert all(point.low == point.flow_l_min == point.high for point in kept.values())
    flows = [point.flow_l_min for point in found.points]
    assert all(a < b for a, b in pairwise(flows))


def test_the_gain_of_the_meter_moves_nothing(records: list[FlowRecord], weighed: Weighed) -> None:
    gained = [replace(record, volume_ml=1.03 * record.volume_ml) for record in records]
    once, twice = identify_curve(records, weighed), identify_curve(gained, weighed)
    for point, other in zip(once.points, twice.points, strict=True):
        assert point.flow_l_min == pytest.approx(other.flow_l_min, rel=1e-12)


def test_valves_take_turns_as_in_flight(setup: Setup) -> None:
    """Valves that begin their periods together share the pressure otherwise than in flight.

    The truth is a long catch of the same imperfect sprayer, in which the pulses have parted.
    """
    del setup
    pinpoint = sprayer_setup("pinpoint", "gpio")
    steady = replace(TYPICAL, ripple=0.0, warming=0.0)
    profile = perfect_meter(replace(load_profile("pinpoint"), imperfections=steady))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curves_module, "STEADY_S", 8.0)
        caught = on_twin(pinpoint, profile, 1)
    metered = {p.duty: p.flow_l_min / (p.ratio or 1.0) for p in caught.points if p.is_weighed}
    (nozzles,) = pinpoint.nozzle_sets
    curve = replace(nozzles.curve, flow_l_min=tuple(metered.values()))
    known = replace(pinpoint, nozzle_sets=(replace(nozzles, curve=curve),))
    found = on_twin(known, profile, 1)
    # Weighed over metered flow is the same at every duty: both saw the same sprayer.
    assert found.ratio_spread < 0.01


def record_from(flows: dict[float, float], order: list[float], *, gain: float = 1.0) -> FlowRecord:
    """Return what a perfect meter, but for its gain, says of duties in turn [L/min]."""
    dwell_s, orders, time_s, volume_ml, before = 3.0, [], [0.0], [0.0], 0.0
    for number, duty in enumerate([*order, 0.0]):
        at_s = 1.0 + number * dwell_s
        orders.append(
            Order(at_s=at_s, valve=0, before=before, after=duty, before_ml_s=0.0, after_ml_s=0.0)
        )
        for _ in range(30 if duty else 0):
            time_s.append(time_s[-1] + 0.1 if len(time_s) > 1 else 1.1)
            volume_ml.append(volume_ml[-1] + gain * flows[duty] / 0.06 * 0.1)
        before = duty
    time_s.append(time_s[-1] + 1.0)
    volume_ml.append(volume_ml[-1])
    return FlowRecord(
        orders=tuple(orders),
        time_s=np.array(time_s),
        volume_ml=np.array(volume_ml),
        period_s=0.1,
        lag=sprayer_setup("wang-2024", "gpio").lag,
    )


@given(
    rises=st.lists(st.floats(0.05, 2.0), min_size=9, max_size=9),
    wrong=st.lists(st.floats(0.97, 1.03), min_size=9, max_size=9),
    gain=st.floats(0.97, 1.03),
)
def test_whatever_meter_and_bucket_say_weighed_flows_stand_and_the_flow_rises(
    rises: list[float], wrong: list[float], gain: float
) -> None:
    duties = [round(0.2 + 0.1 * number, 6) for number in range(9)]
    flows = dict(zip(duties, np.cumsum(rises).tolist(), strict=True))
    metered = {duty: flow * by for (duty, flow), by in zip(flows.items(), wrong, strict=True)}
    weighed = Weighed(
        valves=(0,), duty=tuple(duties[::2]), flow_l_min=tuple(flows[duty] for duty in duties[::2])
    )
    pieces = [record_from(metered, way, gain=gain) for way in (duties, duties[::-1])]
    found = identify_curve(pieces, weighed)
    assert found.weighed_duty == weighed.duty
    stand = [point.flow_l_min for point in found.points if point.is_weighed]
    assert tuple(stand) == weighed.flow_l_min
    assert {point.duty for point in found.points} | set(found.left_out) == set(duties)


def test_a_duty_at_which_the_flow_would_not_rise_is_left_out() -> None:
    weighed = Weighed(valves=(0,), duty=(0.2, 0.6), flow_l_min=(1.0, 3.0))
    flows = {0.2: 1.0, 0.3: 1.6, 0.4: 1.5, 0.5: 3.2, 0.6: 3.0}
    order = list(flows)
    found = identify_curve([record_from(flows, order), record_from(flows, order[::-1])], weighed)
    assert [point.duty for point in found.points] == [0.2, 0.3, 0.6]
    assert found.left_out == (0.4, 0.5)


def test_what_the_meter_does_not_say_is_named() -> None:
    weighed = Weighed(valves=(0,), duty=(0.2, 0.4), flow_l_min=(1.0, 2.0))
    flows = {0.2: 1.0, 0.3: 1.5, 0.4: 2.0}
    there = record_from(flows, [0.2, 0.3, 0.4])
    back = record_from(flows, [0.4, 0.3, 0.2])
    with pytest.raises(CurveCourseError, match="every duty twice"):
        identify_curve([there], weighed)
    with pytest.raises(CurveCourseError, match=r"0 of the weighed duties"):
        identify_curve([there, back], replace(weighed, duty=(0.1, 0.9)))
    silent = replace(back, volume_ml=0.0 * back.volume_ml)
    with pytest.raises(CurveCourseError, match=r"at duty 0\.4 the flow meter counted nothing"):
        identify_curve([there, silent], weighed)
    gap = (back.time_s < 4.5) | (back.time_s > 5.5)
    lost = replace(back, time_s=back.time_s[gap], volume_ml=back.volume_ml[gap])
    with pytest.raises(CurveCourseError, match=r"at duty 0\.3 the flow meter was silent"):
        identify_curve([there, lost], weighed)
    airy = record_from({0.2: 1.3, 0.3: 1.5, 0.4: 1.7}, [0.4, 0.3, 0.2])
    with pytest.raises(CurveCourseError, match="from pass to pass"):
        identify_curve([there, airy], weighed)


def test_the_course_goes_up_and_down_in_pieces_that_ground_work_may_do(
    setup: Setup, weighed: Weighed
) -> None:
    course = curve_course(weighed, setup.pwm, setup.lag)
    pieces = list(course.pieces())
    up = [duty for piece in pieces[: len(pieces) // 2] for duty in piece]
    down = [duty for piece in pieces[len(pieces) // 2 :] for duty in piece]
    assert up == sorted(up) == down[::-1]
    assert set(weighed.duty) <= set(up)
    assert max(b - a for a, b in pairwise(up)) < 0.051
    assert min(b - a for a, b in pairwise(up)) > 0.02
    task = course.task(pieces[0], 6)
    assert task.seconds <= PIECE_MAX_S
    assert task.is_whole
    assert task.phases[5].duty == (pieces[0][0],) * 6


# ---------------------------------------------------------------------------- the command


def config_in(folder: Path, text: str | None = None) -> Path:
    config = folder / "config.toml"
    config.write_text(text or ANYANG.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "prescription.csv").write_text("")
    return config


def test_a_record_is_written_into_the_configuration_and_weighed_points_stay_known(
    records: list[FlowRecord],
    weighed: Weighed,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    record, config, picture = tmp_path / "r.json", config_in(tmp_path), tmp_path / "curve.png"
    write_records(record, NAMES, {weighed.valves: records})
    arguments = ["calibrate", "curve", "--config", str(config), "--from", str(record)]
    assert execute([*arguments, "--plot", str(picture), "--write", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert picture.read_bytes().startswith(b"\x89PNG")
    once = load(config)
    found = identify_curve(records, weighed)
    assert once.nozzle_sets()[-1].curve.duty == found.curve.duty
    assert once.nozzle_sets()[-1].curve.flow_l_min == pytest.approx(
        found.curve.flow_l_min, abs=1e-4
    )
    # A second time: only what was weighed is an anchor.
    assert weighed_sets(once, config) == [weighed]
    assert execute([*arguments, "--write"]) == 0
    told = capsys.readouterr().out
    assert "weighed" in told
    assert load(config).nozzle_set == once.nozzle_set
    assert tomllib.loads(result["toml"])["nozzle_set"][0]["weighed_duty"] == list(weighed.duty)
    # A new bucket test replaces all of it.
    write_back(
        config,
        "[[nozzle_set]]\n"
        f"valves = {json.dumps(NAMES)}\nduty = [0.2, 1.0]\nflow_l_min = [1.5, 6.0]\n",
    )
    assert load(config).nozzle_set[0].weighed_duty == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            "weighed_duty = [0.2, 0.33]",
            "0.33 is not in nozzle_set[0].duty",
        ),
        ("weighed_duty = [0.2]", "one duty"),
    ],
)
def test_a_weighed_duty_that_is_no_point_is_refused(
    change: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = ANYANG.read_text(encoding="utf-8")
    config = config_in(tmp_path, text.replace("[[nozzle_set]]", f"[[nozzle_set]]\n{change}", 1))
    assert execute(["config", "check", str(config)]) == 2
    assert words in capsys.readouterr().out


def test_without_a_meter_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["calibrate", "curve", "--config", str(ANYANG)]) == 2
    error = capsys.readouterr().err
    assert "[flow_meter]" in error
    assert "weigh more duties" in error


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "is not a record"),
        ('{"format": "vrspray-curve-1", "valves": ["a"]}', "other valves"),
        ('{"format": "vrspray-curve-1", "valves": ["1","2","3","4","5","6"]}', "is damaged"),
    ],
)
def test_what_is_no_record_is_one_line(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = tmp_path / "curve.json"
    record.write_text(text)
    assert execute(["calibrate", "curve", "--config", str(ANYANG), "--from", str(record)]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_record_of_other_duties_is_a_failed_measurement(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = tmp_path / "curve.json"
    flows = {0.23: 1.0, 0.33: 1.5}
    pieces = [record_from(flows, way) for way in ([0.23, 0.33], [0.33, 0.23])]
    write_records(record, NAMES, {(0, 1, 2, 3, 4, 5): pieces})
    assert len(read_records(record, NAMES)[(0, 1, 2, 3, 4, 5)]) == 2
    assert execute(["calibrate", "curve", "--config", str(ANYANG), "--from", str(record)]) == 1
    assert "0 of the weighed duties are in the record" in capsys.readouterr().err


def test_a_piece_that_was_broken_off_is_done_again(
    records: list[FlowRecord], weighed: Weighed, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load(ANYANG)
    course = curve_course(weighed, config.pwm_limits(), config.lag_model())
    done: list[GroundTask] = []

    def measure(task: GroundTask) -> Measured:
        done.append(task)
        is_good = len(done) != 2
        record = records[min(len(done) - 1, len(records) - 1)]
        plans = CarriedOut(valve_count=6)
        plans.done = [(order.at_s, order.valve, order.after) for order in record.orders]
        reason = GroundReason.DONE if is_good else GroundReason.NOT_HELD
        return Measured(
            outcome=GroundOutcome(reasons=frozenset({reason}), open_s=3.0, has_begun=True),
            plans=plans,
            time_s=record.time_s.tolist(),
            volume_ml=record.volume_ml.tolist(),
        )

    found = measured_records(config, [course], measure)
    assert len(found[weighed.valves]) == len(list(course.pieces()))
    assert len(done) == len(list(course.pieces())) + 1
    assert "set 1 2 3 4 5 6, piece 2 of 4: the key was released" in capsys.readouterr().err


def test_the_controller_that_knows_the_curve_doses_by_it(
    setup: Setup, records: list[FlowRecord], weighed: Weighed
) -> None:
    found = identify_curve(records, weighed)
    known = with_curves(setup, [found])
    assert known.nozzle_sets[0].curve == found.curve
    flow = found.points[1].flow_l_min
    assert known.nozzle_sets[0].curve.duty_for(flow) == pytest.approx(found.points[1].duty)

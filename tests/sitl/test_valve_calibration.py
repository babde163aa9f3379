"""`calibrate valves` on the twin: what is found of each valve is what the sprayer is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.calibrate_valves import (
    CountRecorder,
    Measured,
    PulseRecorder,
    measured_pieces,
    read_record,
    write_record,
)
from analysis.calibration.steps import CarriedOut, Kind
from analysis.calibration.valves import (
    READINGS_MIN,
    Course,
    Piece,
    ValveCourseError,
    counted_course,
    course_of,
    identify_caught,
    identify_valves,
)
from companion.cli.app import execute
from companion.config import load
from companion.core.setup import Setup
from companion.core.types import BatteryReport, Input
from companion.ground.shell import GroundOutcome
from companion.ground.work import PIECE_MAX_S, GroundReason, GroundTask
from companion.link.component import Component, ComponentOptions
from companion.sensors import Meter
from sitl.flight import FlightOptions
from sitl.profile import Imperfections, Parts, PlantProfile, draw_scatter, load_profile
from sitl.stub.sprayer import FLIGHT_BATTERY, Battery
from sitl.valve_calibration import calibrate_valves, recorded, with_figures
from tests.bench.sprayers import options_of, sprayer_setup
from tests.bench.valves import flow_over_nominal
from tests.sitl import stub_bench
from tests.virtual_edges import VirtualEdges

ANYANG = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"
NAMES = ("1", "2", "3", "4", "5", "6")


def truth(profile: PlantProfile, seed: int) -> tuple[list[float], list[float]]:
    """Return flow ratios and shifts against the mean, from the sprayer that was drawn."""
    drawn = draw_scatter(profile, np.random.default_rng(seed))
    flow = np.array(drawn.flow_scale) / np.mean(drawn.flow_scale)
    shift = np.array(drawn.shift_s) - np.mean(drawn.shift_s)
    return flow.tolist(), shift.tolist()


@pytest.fixture(scope="module")
def profile() -> PlantProfile:
    return load_profile("wang-2024")


@pytest.fixture(scope="module")
def setup() -> Setup:
    return sprayer_setup("wang-2024", "gpio")


@pytest.fixture(scope="module")
def pieces(setup: Setup, profile: PlantProfile) -> list[Piece]:
    course = course_of(setup.pwm, setup.lag, cycles=10, is_alone=True)
    return recorded(setup, profile, FlightOptions(seed=5), course)[0]


def test_flow_and_lags_of_each_valve_are_found(setup: Setup, profile: PlantProfile) -> None:
    errors, late_s, held = [], [], []
    for seed in (1, 2):
        flow, shift = truth(profile, seed)
        found = calibrate_valves(setup, profile, FlightOptions(seed=seed)).found
        for valve, own in enumerate(found.valves):
            errors.append(abs(own.factor.value - flow[valve]))
            held.append(own.factor.low <= flow[valve] <= own.factor.high)
            for lag in own.lags.values():
                late_s.append(abs(lag.value - shift[valve]))
                held.append(lag.low <= shift[valve] <= lag.high)
    assert np.quantile(errors, 0.95) < 0.005
    assert np.quantile(late_s, 0.95) < 0.003
    assert np.mean(held) > 0.85


def test_among_open_valves_it_is_found_less_well_but_as_true(
    setup: Setup, profile: PlantProfile
) -> None:
    flow, _ = truth(profile, 3)
    found = calibrate_valves(setup, profile, FlightOptions(seed=3), is_alone=False).found
    for own, true in zip(found.valves, flow, strict=True):
        assert own.factor.value == pytest.approx(true, abs=0.03)
        assert own.factor.high - own.factor.low < 0.06


def test_the_count_of_the_autopilot_finds_the_flow_and_claims_no_lag(
    setup: Setup, profile: PlantProfile
) -> None:
    errors, held, widths = [], [], []
    for seed in (1, 2, 4):
        flow, _ = truth(profile, seed)
        done = calibrate_valves(setup, profile, FlightOptions(seed=seed), is_counted=True)
        assert done.found.lags == {}
        for own, true in zip(done.found.valves, flow, strict=True):
            assert own.lags == {}
            errors.append(abs(own.factor.value - true))
            held.append(own.factor.low <= true <= own.factor.high)
            widths.append(own.factor.high - own.factor.low)
    assert np.quantile(errors, 0.95) < 0.005
    assert np.mean(held) > 0.85
    assert np.mean(widths) < 0.005


def test_factors_have_the_mean_one_and_lags_the_mean_nought(pieces: list[Piece]) -> None:
    found = identify_valves(pieces, 6)
    assert np.mean([own.factor.value for own in found.valves]) == pytest.approx(1.0)
    for kind in Kind:
        assert np.mean([own.lags[kind].value for own in found.valves]) == pytest.approx(0.0)


def test_the_gain_of_the_meter_moves_nothing(pieces: list[Piece]) -> None:
    gained = [
        Piece(
            valve=piece.valve,
            record=replace(piece.record, volume_ml=1.03 * piece.record.volume_ml),
        )
        for piece in pieces
    ]
    once, twice = identify_valves(pieces, 6), identify_valves(gained, 6)
    for own, other in zip(once.valves, twice.valves, strict=True):
        assert own.factor.value == pytest.approx(other.factor.value, rel=1e-9)
        for kind in Kind:
            assert own.lags[kind].value == pytest.approx(other.lags[kind].value, abs=1e-9)


def test_a_valve_that_does_not_open_is_named(pieces: list[Piece]) -> None:
    silent = [
        piece
        if piece.valve != 2
        else Piece(valve=2, record=replace(piece.record, volume_ml=0.0 * piece.record.volume_ml))
        for piece in pieces
    ]
    with pytest.raises(ValveCourseError, match=r"valve 3: 0 good changes of kind on"):
        identify_valves(silent, 6)


def test_a_worn_nozzle_is_said(
    setup: Setup, profile: PlantProfile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flows = [1.0, 1.0, 1.16, 1.0, 1.0, 1.0]
    found = identify_caught([[10.0 * flow, 10.01 * flow] for flow in flows])
    assert [own.is_worn for own in found.valves] == [False, False, True, False, False, False]
    catch = tmp_path / "catch.csv"
    rows = [f"{n},30,{300 * f + d:.1f}" for n, f in zip(NAMES, flows, strict=True) for d in (0, 1)]
    catch.write_text("valve,seconds,millilitres\n" + "\n".join(rows) + "\n")
    assert execute(["calibrate", "valves", "--config", str(ANYANG), "--catch", str(catch)]) == 0
    told = capsys.readouterr().out
    assert "valve 3: +13 % from the others" in told
    assert "worn" in told


def test_a_record_is_evaluated_again_and_written_into_the_configuration(
    pieces: list[Piece], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record, config = tmp_path / "valves.json", tmp_path / "config.toml"
    write_record(record, NAMES, pieces, "2026-05-01")
    assert len(read_record(record, NAMES)[0]) == len(pieces)
    config.write_text(ANYANG.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "prescription.csv").write_text("")
    picture = tmp_path / "valves.png"
    arguments = ["--config", str(config), "--from", str(record), "--plot", str(picture)]
    assert execute(["calibrate", "valves", *arguments, "--write", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    found = identify_valves(pieces, 6)
    for told, own in zip(result["valves"], found.valves, strict=True):
        assert told["flow_factor"]["value"] == pytest.approx(own.factor.value, abs=1e-6)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert {(each.measured_on, each.measured_with) for each in load(config).valve} == {
        ("2026-05-01", "water")
    }
    assert load(config).lag.measured_on is None
    shares = [load(config).nozzle_sets()[-1].share(valve) for valve in range(6)]
    assert shares == pytest.approx([own.factor.value for own in found.valves], abs=1e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "is not a record"),
        ("nonsense", "cannot be read"),
        ('{"format": "vrspray-valves-1", "valves": ["a"]}', "other valves"),
        ('{"format": "vrspray-valves-1", "valves": ["1","2","3","4","5","6"]}', "is damaged"),
    ],
)
def test_what_is_no_record_is_one_line(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = tmp_path / "valves.json"
    record.write_text(text)
    assert execute(["calibrate", "valves", "--config", str(ANYANG), "--from", str(record)]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_without_a_meter_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["calibrate", "valves", "--config", str(ANYANG)]) == 2
    error = capsys.readouterr().err
    assert "[flow_meter]" in error
    assert "--catch CSV" in error


def test_the_controller_that_knows_its_valves_has_their_figures(
    setup: Setup, pieces: list[Piece]
) -> None:
    found = identify_valves(pieces, 6)
    known = with_figures(setup, found)
    assert [known.nozzle_sets[-1].share(valve) for valve in range(6)] == pytest.approx(
        [own.factor.value for own in found.valves]
    )
    leads = [timing.up_s - setup.timing.up_s for timing in known.timings]
    assert leads == pytest.approx([own.lags[Kind.UP].value for own in found.valves])


# ------------------------------------------------------------------------- the work at the vehicle


class Bench:
    """A vehicle on the ground: gives recorded pieces, but of those numbers (from 1) none."""

    def __init__(self, pieces: list[Piece], spoilt: dict[int, GroundOutcome]) -> None:
        self.pieces, self.spoilt, self.count, self.done = pieces, spoilt, 0, 0

    def measure(self, task: GroundTask) -> Measured:
        self.count += 1
        record = self.pieces[self.done].record
        plans = CarriedOut(valve_count=6)
        plans.done = [(order.at_s, order.valve, order.after) for order in record.orders]
        outcome = self.spoilt.get(self.count)
        if outcome is None:
            outcome = GroundOutcome(
                reasons=frozenset({GroundReason.DONE}), open_s=task.seconds, has_begun=True
            )
            self.done += 1
        return Measured(
            outcome=outcome,
            plans=plans,
            time_s=record.time_s.tolist(),
            volume_ml=record.volume_ml.tolist(),
        )


LET_GO = GroundOutcome(reasons=frozenset({GroundReason.NOT_HELD}), open_s=3.0, has_begun=True)
ARMED = GroundOutcome(reasons=frozenset({GroundReason.ARMED}), open_s=0.0, has_begun=False)


def course() -> Course:
    config = load(ANYANG)
    return course_of(config.pwm_limits(), config.lag_model(), cycles=10, is_alone=True)


def test_a_piece_that_was_broken_off_is_done_again(
    pieces: list[Piece], capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(pieces, {2: LET_GO})
    found = measured_pieces(load(ANYANG), course(), bench.measure)
    assert bench.count == len(pieces) + 1
    assert [piece.valve for piece in found] == [piece.valve for piece in pieces]
    # The configured lags say where steady flow is looked for.
    lag = load(ANYANG).lag_model()
    same = [replace(piece, record=replace(piece.record, lag=lag)) for piece in pieces]
    once, twice = identify_valves(same, 6), identify_valves(found, 6)
    assert [own.factor.value for own in once.valves] == pytest.approx(
        [own.factor.value for own in twice.valves], rel=1e-4
    )
    assert "valve 2, piece 1 of 2: the key was released" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ({3: LET_GO, 4: LET_GO, 5: LET_GO}, "valve 3, piece 1 of 2: given up after 3 tries"),
        ({1: ARMED}, "valve 1, piece 1 of 2: nothing was opened: the vehicle is armed"),
    ],
)
def test_what_cannot_be_measured_is_said(
    pieces: list[Piece], spoilt: dict[int, GroundOutcome], words: str
) -> None:
    with pytest.raises(ValveCourseError, match=words):
        measured_pieces(load(ANYANG), course(), Bench(pieces, spoilt).measure)


def test_no_piece_opens_another_valve_or_takes_longer_than_ground_work_may() -> None:
    for valve in range(6):
        task = course().task(valve, 6)
        assert task.seconds <= PIECE_MAX_S
        assert task.is_whole
        assert task.phases[0].duty == task.phases[-1].duty == (0.0,) * 6
        opened = {n for phase in task.phases for n, duty in enumerate(phase.duty) if duty > 0.0}
        assert opened == {valve}


def test_pieces_go_there_and_back_so_that_what_drifts_comes_to_every_valve_alike() -> None:
    rounds = list(course().rounds(6))
    middle = 0.5 * (len(rounds) - 1)
    for valve in range(6):
        turns = [at - middle for at, (number, _) in enumerate(rounds) if number == valve]
        assert sum(turns) == 0.0
        assert [piece for number, piece in rounds if number == valve] == [1, 2]


def test_a_factor_is_right_at_both_levels_of_a_valve_that_delivers_longer_at_every_pulse() -> None:
    what = Imperfections(offset_scatter_s=0.001)
    bent = replace(load_profile("wang-2024"), flow_scatter=0.0, lag_scatter=0.0, imperfections=what)
    options = options_of("gpio", 4)
    found = calibrate_valves(sprayer_setup("wang-2024", "gpio"), bent, options, cycles=10).found
    parts = Parts(what, 6, seed=4, start_s=0.0)
    for valve, own in enumerate(found.valves):
        assert own.factor.value == pytest.approx(
            flow_over_nominal(parts, valve, bent.pwm.period_s), abs=0.004
        )


async def test_every_pulse_keeps_its_time_and_a_lost_one_is_said() -> None:
    source = VirtualEdges()
    meter = Meter(pulses_per_l=4600.0, flow_max_l_min=10.0, pwm_period_s=1 / 11)
    recorder = PulseRecorder(meter, source)
    await recorder.open(lambda: None)
    assert recorder.read(10.0) == []
    source.put(10.01, 10.03, 10.0301, 10.05)  # the third is an echo of the second
    recorder.read(10.06)
    assert recorder.time_s == [10.0, 10.01, 10.03, 10.05]
    assert recorder.volume_ml == pytest.approx([0.0, *(n / 4.6 for n in (1, 2, 3))])
    assert recorder.fault == ""
    source.put(10.2, lost=2)
    recorder.read(10.25)
    assert recorder.volume_ml[-1] == pytest.approx(6 / 4.6)
    assert "pulses lost" in recorder.fault
    await recorder.close()
    assert not source.is_open


# ---------------------------------------------------------------------- the autopilot's flow meter


class Wire:
    """The link of ground work to the stub, in the stub's own time."""

    def __init__(self, battery: int, ml_s: float) -> None:
        self.bench = stub_bench.Bench(autopilot="ardupilot")
        self.recorder = CountRecorder(battery)
        self._heard: list[Input] = []
        self.bench.autopilot.batteries = lambda now_s: [
            FLIGHT_BATTERY,
            Battery(number=1, consumed=int(ml_s * now_s), remaining_percent=None),
        ]
        self._channel = self.bench.autopilot.attach("companion", self._take)
        self._component = Component(ComponentOptions(use_battery=True), self._send)
        self._link = self.recorder.around(self)  # type: ignore[arg-type]

    def _send(self, frame: bytes) -> bool:
        self.bench.autopilot.receive(self._channel, frame, self.bench.now_s)
        return True

    def _take(self, frame: bytes) -> None:
        self._heard += self._component.receive(frame, self.bench.now_s)

    def receive(self) -> list[Input]:
        heard, self._heard = self._heard, []
        return heard

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / 0.1)):
            self.bench.run(0.1)
            self._component.tick(None, self.bench.now_s)
            self._link.receive()


def test_the_count_of_the_autopilot_comes_over_the_wire_often_enough() -> None:
    wire = Wire(battery=1, ml_s=8.0)
    wire.run(14.0)
    time_s, volume_ml = wire.recorder.time_s, wire.recorder.volume_ml
    assert wire.recorder.fault == ""
    steady = [at_s > time_s[0] + 4.0 for at_s in time_s]
    assert sum(steady) >= 2 * READINGS_MIN
    slope = np.polyfit(np.array(time_s)[steady], np.array(volume_ml)[steady], 1)[0]
    assert slope == pytest.approx(8.0, rel=0.02)


def test_a_monitor_that_is_not_the_meter_is_said() -> None:
    wire = Wire(battery=3, ml_s=8.0)
    wire.run(5.0)
    assert wire.recorder.time_s == []
    assert "battery monitor 3" in wire.recorder.fault
    assert "BATTn_MONITOR" in wire.recorder.fault


def counted(reports: list[tuple[float, float | None]]) -> str:
    """Return what is said of these counts."""
    recorder = CountRecorder(1)

    class Link:
        def receive(self) -> list[Input]:
            return [
                BatteryReport(received_s=at_s, battery=1, consumed=ml, remaining_percent=None)
                for at_s, ml in reports
            ]

    recorder.around(Link()).receive()  # type: ignore[arg-type]
    return recorder.fault


def test_counts_that_cannot_be_used_are_said() -> None:
    assert counted([(0.0, 5.0), (0.3, 5.0), (0.6, 8.0)]) == ""
    assert "has restarted" in counted([(0.0, 5.0), (0.3, 0.0)])
    assert "for 3.0 s" in counted([(0.0, 5.0), (3.0, 30.0)])
    assert "no count" in counted([(0.0, None)])


def test_counts_that_do_not_say_the_flow_are_refused(
    setup: Setup, profile: PlantProfile, tmp_path: Path
) -> None:
    course = counted_course(setup.pwm, cycles=6, is_alone=True)
    pieces, _ = recorded(setup, profile, FlightOptions(seed=5), course)
    record = tmp_path / "counts.json"
    write_record(record, NAMES, pieces, "2026-05-01")
    again = identify_valves(read_record(record, NAMES)[0], 6)
    assert again.valves[0].factor.value == pytest.approx(
        identify_valves(pieces, 6).valves[0].factor.value, abs=1e-4
    )
    still = replace(pieces[0].record, volume_ml=0.0 * pieces[0].record.volume_ml)
    with pytest.raises(ValveCourseError, match="does not grow faster while it sprays"):
        identify_valves([replace(pieces[0], record=still), *pieces[1:]], 6)
    few = replace(
        still, time_s=pieces[0].record.time_s[::20], volume_ml=pieces[0].record.volume_ml[::20]
    )
    with pytest.raises(ValveCourseError, match="counts of the autopilot within"):
        identify_valves([replace(pieces[0], record=few), *pieces[1:]], 6)

"""Whether a vehicle is simulated: no simulation is taken for real, and no flight for one."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.journal.journal import Journal
from companion.journal.reader import opened
from companion.link.simulation import SIMSTATE, judge, mode_sign, sensor_sign
from companion.simulated import SIMULATED, Simulated, parsed, simulated_in
from tests import builders
from tests.companion.test_px4_output import Peer

ARDUPILOT, PX4 = 3, 12
# ArduCopter 4.7-dev and PX4 1.16-alpha in their simulations, measured; device numbers of real
# boards: an ICM-20689 and an ICM-42688 on SPI (bus type 2).
SIMULATED_COPTER = {"INS_ACC_ID": 2753028.0, "INS_GYR_ID": 2752772.0, "SIM_SPEEDUP": 1.0}
REAL_COPTER = {"INS_ACC_ID": 3408394.0, "INS_GYR_ID": 3408138.0}
SIMULATED_PX4 = {"CAL_ACC0_ID": 1310988.0, "CAL_GYRO0_ID": 1310988.0, "SYS_HITL": 0.0}
# SIM_GPS_USED and the like are on real boards too: nobody asks for them.
REAL_PX4 = {"CAL_ACC0_ID": 2490378.0, "CAL_GYRO0_ID": 2490378.0, "SYS_HITL": 0.0}


class Bench:
    """A component, and a vehicle that answers what its table has."""

    def __init__(self, autopilot: int, table: dict[str, float], *, flags: int = 0) -> None:
        self.peer, self.table, self.flags = Peer(autopilot), table, flags
        self.told: list[str] = []
        self.asked: list[str] = []
        self.peer.component.on_event = self._event

    def _event(self, _at_s: float, kind: str, text: str) -> None:
        self.told += [text] if kind == SIMULATED else []

    def run(self, from_s: float, until_s: float, *, armed: bool = False) -> Simulated:
        at_s, beat_s = from_s, from_s
        while at_s < until_s:
            if at_s >= beat_s:
                mode = self.flags | (128 if armed else 0)
                beat = self.peer.mav.heartbeat_encode(2, self.peer.autopilot, mode, 0, 3)
                self.peer.say(beat, at_s)
                beat_s += 1.0
            self.peer.frames.clear()
            self.peer.component.tick(None, at_s)
            for question in self.peer.of("PARAM_REQUEST_READ"):
                self.asked.append(question.param_id)
                self._answer(question.param_id, at_s)
            at_s += 0.05
        return self.peer.component.simulation.verdict

    def _answer(self, name: str, at_s: float) -> None:
        if name in self.table:
            self.say(name, self.table[name], at_s)

    def say(self, name: str, value: float, at_s: float) -> None:
        kind = 9
        if self.peer.autopilot == PX4:
            (value,), kind = struct.unpack("<f", struct.pack("<i", int(value))), 6
        self.peer.say(
            self.peer.mav.param_value_encode(name.encode(), value, kind, 900, 5), at_s + 0.01
        )


@pytest.mark.parametrize(
    ("autopilot", "table", "word"),
    [
        (ARDUPILOT, SIMULATED_COPTER, "yes"),
        (ARDUPILOT, REAL_COPTER, "no"),
        (PX4, SIMULATED_PX4, "yes"),
        (PX4, REAL_PX4, "no"),
        (PX4, {**REAL_PX4, "SYS_HITL": 2.0}, "unknown"),
        (ARDUPILOT, {}, "unknown"),
        (PX4, {"CAL_ACC0_ID": 0.0, "CAL_GYRO0_ID": 0.0, "SYS_HITL": 0.0}, "unknown"),
        (ARDUPILOT, {"INS_ACC_ID": 3408394.0}, "unknown"),
        # An autopilot of neither kind answers nothing that we know.
        (4, {}, "unknown"),
    ],
)
def test_what_a_vehicle_answers_tells_what_it_is(
    autopilot: int, table: dict[str, float], word: str
) -> None:
    bench = Bench(autopilot, table)
    verdict = bench.run(1.0, 8.0)
    assert verdict.word == word
    assert verdict.because
    assert bench.told[-1] == verdict.text
    assert len(bench.asked) <= 12


def test_one_forged_answer_or_message_makes_no_real_flight_a_simulation() -> None:
    bench = Bench(ARDUPILOT, REAL_COPTER)
    bench.run(1.0, 1.06)
    bench.say("SIM_SPEEDUP", 1.0, 1.06)
    bench.say("SIM_SPEEDUP", 1.0, 1.06)
    verdict = bench.run(1.1, 8.0)
    assert verdict.word == "unknown"
    assert "only one sign: SIM_SPEEDUP" in verdict.because
    bench = Bench(ARDUPILOT, REAL_COPTER)
    bench.run(1.0, 8.0)
    for _ in range(2):
        bench.peer.say(bench.peer.mav.simstate_encode(*[0.0] * 9, 0, 0), 8.0)
    assert bench.run(8.1, 12.0).word == "no"


def test_an_answer_that_nobody_asked_for_counts_for_nothing() -> None:
    bench = Bench(ARDUPILOT, REAL_COPTER)
    assert bench.run(1.0, 8.0).word == "no"
    for name, value in SIMULATED_COPTER.items():
        bench.say(name, value, 8.0)
    assert bench.run(8.1, 12.0).word == "no"


def test_messages_of_a_simulation_are_a_sign_against_a_real_one() -> None:
    bench = Bench(ARDUPILOT, REAL_COPTER)
    bench.run(1.0, 8.0)
    for _ in range(3):
        bench.peer.say(bench.peer.mav.simstate_encode(*[0.0] * 9, 0, 0), 8.0)
    assert bench.run(8.1, 9.0).word == "unknown"
    assert bench.peer.component.codec.vehicle_counts[SIMSTATE] == 3


def test_hardware_in_the_loop_is_a_simulation() -> None:
    assert Bench(PX4, {**REAL_PX4, "SYS_HITL": 1.0}, flags=32).run(1.0, 8.0).word == "yes"


def test_nothing_is_asked_in_flight_and_all_of_it_after_the_landing() -> None:
    bench = Bench(ARDUPILOT, SIMULATED_COPTER)
    verdict = bench.run(1.0, 8.0, armed=True)
    assert (verdict.word, bench.asked) == ("unknown", [])
    assert "in flight" in verdict.because
    assert bench.run(8.0, 12.0).word == "yes"


def test_a_simulation_stays_one() -> None:
    bench = Bench(ARDUPILOT, SIMULATED_COPTER)
    assert bench.run(1.0, 8.0).word == "yes"
    bench.table = dict(REAL_COPTER)
    bench.peer.component.link_changed(8.0)
    assert bench.run(8.0, 16.0).word == "yes"


@given(value=st.none() | st.floats(allow_nan=True))
def test_any_number_of_a_sensor_is_read_and_never_taken_on_trust(value: float | None) -> None:
    sign = sensor_sign("INS_ACC_ID", value)
    if sign.is_simulated is not None:
        assert value is not None
        assert 0.0 < value < 2.0**31
        assert sign.is_simulated == (int(value) % 8 == 4)


def test_signs_are_counted_by_their_source() -> None:
    sensors = ("INS_ACC_ID", "INS_GYR_ID")
    real = [sensor_sign(name, 3408394.0) for name in sensors]
    assert judge([*real, mode_sign(None, is_px4=False)], sensors=sensors).word == "no"
    assert judge([], sensors=sensors).word == "unknown"


# --------------------------------------------------------------------------------- the journal


def meta_of(path: Path) -> dict[str, str]:
    with opened(path) as journal:
        return dict(journal.meta)


def test_a_journal_says_unknown_until_the_vehicle_has_told(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=builders.setup(), training="no") as journal:
        pass
    assert simulated_in(meta_of(journal.path)).word == "unknown"
    with Journal.create(tmp_path, setup=builders.setup(), training="no") as journal:
        journal.record_event(1.0, SIMULATED, "yes: INS_ACC_ID 2753028 is a simulated sensor")
    found = simulated_in(meta_of(journal.path))
    assert found == Simulated(word="yes", because="INS_ACC_ID 2753028 is a simulated sensor")


def test_a_journal_of_before_is_unmarked_and_a_twins_was_always_simulated() -> None:
    assert simulated_in({"training": "no"}).is_unmarked
    assert simulated_in({"training": "simulated"}).is_simulated
    assert not simulated_in({"simulated": "no", "simulated_because": "x"}).label


@given(text=st.text())
def test_a_damaged_mark_is_never_a_real_flight(text: str) -> None:
    found = parsed(text)
    assert found.word != "no" or text.startswith("no: ")
    assert len(found.because) <= 300

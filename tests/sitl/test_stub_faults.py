"""Each fault does what its name says, while it is in force, and nothing after it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from companion.errors import ConfigError
from sitl.scenario_file import read_scenario
from sitl.stub.faults import Fault, FaultKind
from sitl.stub.mission_items import AUTO, LOITER, Phase
from sitl.stub.protocol import dialect
from tests.sitl.stub_bench import Bench, mission

POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
SERVO = (dialect.MAV_CMD_DO_SET_SERVO, 9, 1500)


def faulty(kind: FaultKind, **more: Any) -> Bench:
    """A stub in flight at 5 m/s, with a fault from 10 s to 12 s."""
    fault = Fault(**{"kind": kind, "at_s": 10.0, "duration_s": 2.0, **more})
    bench = Bench(items=mission((0.0, 200.0)), faults=(fault,))
    bench.companion.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, POSITION, 50_000)
    bench.fly()
    bench.run(9.9)
    return bench


def positions(bench: Bench) -> list[Any]:
    return bench.companion.of("GLOBAL_POSITION_INT")


def counted(bench: Bench, kind: str, duration_s: float) -> int:
    before = len(bench.companion.of(kind))
    bench.run(duration_s)
    return len(bench.companion.of(kind)) - before


def test_every_kind_is_tested() -> None:
    tests = Path(__file__).parent.glob("test_stub_*.py")
    text = "".join(path.read_text(encoding="utf-8") for path in tests)
    assert not {
        kind
        for kind in FaultKind
        if f"FaultKind.{kind.name})" not in text and f"FaultKind.{kind.name}," not in text
    }


def test_lost_acknowledgements_never_come() -> None:
    bench = faulty(FaultKind.ACK_LOST)
    bench.run(0.5)
    assert bench.companion.command(*SERVO) is None
    bench.run(2.0)
    assert bench.companion.command(*SERVO) == 0


def test_a_lost_acknowledgement_does_not_undo_the_order() -> None:
    bench = faulty(FaultKind.ACK_LOST)
    bench.run(0.5)
    bench.companion.command(*SERVO)
    assert bench.orders


def test_late_acknowledgements_come_later() -> None:
    bench = faulty(FaultKind.ACK_LATE, delay_s=0.5)
    bench.run(0.5)
    assert bench.companion.command(*SERVO) is None
    bench.run(0.6)
    assert bench.companion.last("COMMAND_ACK").command == SERVO[0]


def test_doubled_acknowledgements_come_twice() -> None:
    bench = faulty(FaultKind.ACK_DOUBLED)
    bench.run(0.5)
    before = len(bench.companion.of("COMMAND_ACK"))
    bench.companion.command(*SERVO)
    assert len(bench.companion.of("COMMAND_ACK")) - before == 2


def test_without_position_the_stream_stops_and_heartbeats_go_on() -> None:
    bench = faulty(FaultKind.NO_POSITION)
    bench.run(0.2)
    beats = len(bench.companion.of("HEARTBEAT"))
    assert counted(bench, "GLOBAL_POSITION_INT", 1.5) == 0
    assert len(bench.companion.of("HEARTBEAT")) > beats
    bench.run(0.5)
    assert counted(bench, "GLOBAL_POSITION_INT", 1.0) == pytest.approx(20, abs=1)


def test_a_stale_position_goes_on_with_zero_velocity_while_the_estimator_says_so() -> None:
    bench = faulty(FaultKind.STALE_POSITION)
    bench.run(0.3)
    first = positions(bench)[-1]
    bench.run(1.0)
    last = positions(bench)[-1]
    assert (last.lat, last.lon, last.vx, last.vy) == (first.lat, first.lon, 0, 0)
    assert last.time_boot_ms > first.time_boot_ms
    ekf = bench.companion.request(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert ekf.flags & dialect.ESTIMATOR_CONST_POS_MODE
    assert not ekf.flags & dialect.ESTIMATOR_POS_HORIZ_ABS


def test_a_healthy_estimator_says_so() -> None:
    ekf = Bench().companion.request(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    needed = dialect.ESTIMATOR_POS_HORIZ_ABS | dialect.ESTIMATOR_VELOCITY_HORIZ
    assert ekf.flags & needed == needed
    assert not ekf.flags & dialect.ESTIMATOR_CONST_POS_MODE


def test_a_zero_position_is_zero() -> None:
    bench = faulty(FaultKind.ZERO_POSITION)
    bench.run(0.3)
    assert (positions(bench)[-1].lat, positions(bench)[-1].lon) == (0, 0)


def test_an_extreme_position_is_beyond_the_pole() -> None:
    bench = faulty(FaultKind.EXTREME_POSITION)
    bench.run(0.3)
    assert positions(bench)[-1].lat == 2**31 - 1


def test_an_unknown_heading_is_65535() -> None:
    bench = faulty(FaultKind.HEADING_UNKNOWN)
    bench.run(0.3)
    assert positions(bench)[-1].hdg == 65535


def test_a_dropped_fix_is_told_by_the_receiver() -> None:
    bench = faulty(FaultKind.GPS_DROP, fix=2)
    assert bench.companion.request(dialect.MAVLINK_MSG_ID_GPS_RAW_INT).fix_type == 6
    bench.run(0.3)
    assert bench.companion.request(dialect.MAVLINK_MSG_ID_GPS_RAW_INT).fix_type == 2


def test_the_clock_wraps_after_its_32_bits() -> None:
    bench = faulty(FaultKind.CLOCK_WRAP, delay_s=1.0)
    bench.run(0.6)
    before = positions(bench)[-1].time_boot_ms
    bench.run(1.0)
    after = positions(bench)[-1].time_boot_ms
    assert before > 2**32 - 1000
    assert after < 1000


def test_the_clock_goes_backwards() -> None:
    bench = faulty(FaultKind.CLOCK_BACKWARDS, delay_s=5.0)
    before = positions(bench)[-1].time_boot_ms
    bench.run(0.3)
    assert before - 6000 < positions(bench)[-1].time_boot_ms < before - 4000


def test_a_reboot_forgets_the_streams_and_starts_the_clock_again() -> None:
    bench = faulty(FaultKind.REBOOT)
    bench.run(0.3)
    assert counted(bench, "GLOBAL_POSITION_INT", 1.0) == 0
    assert bench.companion.request(POSITION).time_boot_ms < 2000


def test_garbage_hides_no_more_than_the_frames_it_swallows() -> None:
    bench = faulty(FaultKind.GARBAGE, fraction=0.5)
    bench.run(2.0)
    assert bench.companion.bad_count > 0
    bench.run(1.0)
    assert counted(bench, "GLOBAL_POSITION_INT", 1.0) == pytest.approx(20, abs=1)


def test_corrupt_frames_do_not_arrive() -> None:
    bench = faulty(FaultKind.CORRUPT, fraction=1.0)
    bench.run(0.3)
    assert counted(bench, "GLOBAL_POSITION_INT", 1.0) <= 1


def test_others_heartbeats_are_heard_beside_the_vehicles() -> None:
    bench = faulty(FaultKind.FOREIGN)
    bench.run(1.5)
    beats = {(m.get_srcSystem(), m.get_srcComponent()) for m in bench.companion.of("HEARTBEAT")}
    assert beats == {(1, 1), (1, 154), (1, 156), (255, 190), (2, 1)}


def test_streams_slow_down() -> None:
    bench = faulty(FaultKind.SLOW_STREAMS, factor=5.0)
    bench.run(0.3)
    assert counted(bench, "GLOBAL_POSITION_INT", 1.5) == pytest.approx(6, abs=1)


def test_silence_goes_both_ways() -> None:
    bench = faulty(FaultKind.SILENCE)
    bench.run(0.2)
    before = len(bench.companion.messages)
    assert bench.companion.command(*SERVO) is None
    bench.run(1.5)
    assert len(bench.companion.messages) == before
    assert not bench.orders
    bench.run(1.0)
    assert len(bench.companion.messages) > before


def test_the_pilot_takes_over_and_gives_back() -> None:
    bench = faulty(FaultKind.MODE, mode=LOITER)
    bench.run(0.5)
    assert bench.autopilot.flight.mode == LOITER
    bench.run(2.0)
    assert bench.autopilot.flight.mode == AUTO
    assert bench.autopilot.flight.phase is Phase.ROUTE


def test_a_fault_can_count_from_the_take_off() -> None:
    fault = Fault(kind=FaultKind.ZERO_POSITION, at_s=1.0, since="take-off")
    bench = Bench(items=mission((0.0, 100.0)), faults=(fault,))
    bench.run(30.0)
    assert bench.companion.request(POSITION).lat != 0
    bench.fly()
    bench.run(1.5)
    assert bench.companion.request(POSITION).lat == 0


def test_a_scenario_is_read(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(
        '[[fault]]\nkind = "silence"\nat_s = 5.0\nduration_s = 2.0\nsince = "take-off"\n'
    )
    [fault] = read_scenario(path)
    assert (fault.kind, fault.at_s, fault.duration_s) == (FaultKind.SILENCE, 5.0, 2.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[fault]]\n", 'kind: missing; write one of "ack-lost", '),
        ('[[fault]]\nkind = "gremlins"\n', "gremlins"),
        (
            '[[fault]]\nkind = "silence"\nwhen = 3\n',
            r"fault\[0\].when = 3: unknown key; .* can have: kind, at_s",
        ),
        ('[[fault]]\nkind = "silence"\nfraction = 2.0\n', "fraction"),
        ('[[fault]]\nkind = "silence"\nat_s = nan\n', "at_s"),
        ('[[fault]]\nkind = "silence"\nat_s = "soon"\n', 'at_s = "soon": not a number'),
        ('[[fault]]\nkind = "gps-drop"\nfix = 1.5\n', "fix = 1.5: not a whole number"),
        (
            '[[fault]]\nkind = "silence"\nfactor = 2.0\n',
            r"fault\[0\].factor = 2.0: means nothing to kind",
        ),
        ('[[fault]]\nkind = "rc"\npulse_us = 9000\n', "pulse_us"),
        ("[wind]\nspeed_m_s = 3.0\n", "wind: only"),
        ("fault = 3\n", r"write \[\[fault\]\] tables"),
        ("fault = [3]\n", r"fault\[0\] = 3: not a table"),
        ("fault = [\n", "not valid TOML"),
    ],
)
def test_a_broken_scenario_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        read_scenario(path)
    assert "\n" not in str(caught.value)

"""The engine in a time of its own: what each fault does to the lines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.engine.engine import BEAT_S, GAP_S, Engine
from companion.output.engine.lines import MemoryLines
from companion.output.engine.wire import (
    EngineSetup,
    Issued,
    Kind,
    Wiring,
    edges_from,
    pack,
    pack_plan,
    unpack,
)

PWM = PwmLimits(frequency_hz=10.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
WIRING = Wiring(valves=(17, 18), return_line=22, alive_line=4)
RETURN, ALIVE = 0b0100, 0b1000


@dataclass
class Bench:
    """An engine, its lines, and a clock that only this test moves."""

    wiring: Wiring = WIRING
    now_s: float = 100.0
    slept_s: float = 0.0
    listens: bool = True
    told: list[tuple[Kind, bytes]] = field(default_factory=list)
    seen: list[tuple[float, int]] = field(default_factory=list)
    sequence: int = 0

    def __post_init__(self) -> None:
        self.lines = MemoryLines(self.wiring.safe_levels)
        self.engine = Engine(
            EngineSetup(wiring=self.wiring, pwm=PWM, backend="memory"),
            self.lines,
            clock=lambda: self.now_s,
            boot_clock=lambda: self.now_s + self.slept_s,
            send=self._take,
        )

    def _take(self, packet: bytes) -> bool:
        if self.listens:
            self.told.append(unpack(packet))
        return self.listens

    def plan(
        self, *duty: float, lease_s: float = 0.3, changes: tuple[TimedChange, ...] = ()
    ) -> None:
        self.sequence += 1
        self.submit(
            SprayPlan(
                sequence=self.sequence,
                issued_s=self.now_s,
                duty=duty,
                changes=changes,
                lease_until_s=self.now_s + lease_s,
            )
        )

    def submit(self, plan: SprayPlan) -> None:
        self.engine.receive(*unpack(pack_plan(plan)))
        self.turn()

    def turn(self) -> None:
        self.engine.turn()
        self.seen.append((self.now_s, self.lines.levels))

    def run(self, for_s: float, *, renew: tuple[float, ...] = ()) -> None:
        """Let time pass as the process does: from one event to the next."""
        end_s = self.now_s + for_s
        renew_s = self.now_s
        while True:
            next_s = min(max(self.engine.next_s, self.now_s), renew_s if renew else end_s)
            if not next_s < end_s:
                break
            self.now_s = next_s
            if renew and self.now_s >= renew_s:
                self.plan(*renew)
                renew_s += 0.05
            self.turn()
        self.now_s = end_s
        self.turn()

    @property
    def valves(self) -> int:
        return self.lines.levels & 0b11

    @property
    def edges(self) -> list[Issued]:
        return [e for kind, body in self.told if kind is Kind.EDGES for e in edges_from(body)]

    @property
    def faults(self) -> list[str]:
        return [body.decode() for kind, body in self.told if kind is Kind.FAULT]


@pytest.fixture
def bench() -> Iterator[Bench]:
    yield Bench()


def test_it_begins_closed_and_stays_so(bench: Bench) -> None:
    bench.run(1.0)
    assert bench.lines.levels == WIRING.safe_levels == 0
    assert not bench.engine.status().is_alive


def test_a_plan_opens_and_its_lease_closes(bench: Bench) -> None:
    bench.plan(1.0, 1.0)
    assert bench.valves == 0b11
    bench.run(0.299)
    assert bench.valves == 0b11
    bench.run(0.002)
    assert bench.valves == 0
    assert bench.engine.status().lease_ends == 1
    bench.run(1.0)
    assert bench.valves == 0
    assert bench.engine.status().lease_ends == 1
    bench.plan(1.0, 1.0)
    bench.run(1.0)
    assert bench.engine.status().lease_ends == 2


def test_the_return_valve_shuts_after_the_valves_open_and_opens_before_they_close(
    bench: Bench,
) -> None:
    off = TimedChange(at_s=100.2, valve=0, duty=0.0)
    bench.plan(1.0, 0.0, changes=(off,))
    bench.run(0.3)
    moves = {(bool(levels & 1), bool(levels & RETURN)) for _, levels in bench.seen}
    # The return is normally open: its coil is fed to shut it. Never both shut.
    assert moves == {(False, False), (True, False), (True, True)}
    shut = [at_s for at_s, levels in bench.seen if levels & RETURN]
    assert shut[0] == pytest.approx(100.02)
    opened = next(at_s for at_s, levels in bench.seen if at_s > 100.1 and not levels & RETURN)
    assert opened == pytest.approx(100.175)


def test_alive_toggles_only_while_a_lease_runs(bench: Bench) -> None:
    bench.run(0.5, renew=(0.0, 0.0))
    toggles = [b ^ a for (_, a), (_, b) in pairwise(bench.seen)]
    assert sum(bool(change & ALIVE) for change in toggles) == pytest.approx(10, abs=1)
    bench.run(0.4)
    before = bench.lines.levels & ALIVE
    count = len(bench.seen)
    bench.run(1.0)
    assert {levels & ALIVE for _, levels in bench.seen[count:]} == {before}


def test_a_standstill_closes_first_and_old_plans_are_void(bench: Bench) -> None:
    bench.run(0.2, renew=(1.0, 0.5))
    old = SprayPlan(
        sequence=90, issued_s=bench.now_s, duty=(1.0, 1.0), changes=(),
        lease_until_s=bench.now_s + 0.3,
    )  # fmt: skip
    bench.now_s += GAP_S + 0.01
    bench.turn()
    assert bench.valves == 0
    assert bench.engine.status().stops == 1
    bench.submit(old)
    assert bench.valves == 0
    assert bench.engine.rejected == 1
    bench.run(0.1)
    assert bench.valves == 0
    bench.plan(1.0, 1.0)
    assert bench.valves == 0b11


def test_alive_stands_still_after_a_standstill_until_a_new_plan(bench: Bench) -> None:
    bench.run(0.2, renew=(1.0, 0.5))
    bench.now_s += GAP_S + 0.01
    bench.turn()
    assert not bench.engine.status().is_alive
    count = len(bench.seen)
    bench.run(0.5)
    assert len({levels & ALIVE for _, levels in bench.seen[count:]}) == 1
    bench.plan(0.0, 0.0)
    assert bench.engine.status().is_alive


def test_signs_of_life_keep_their_mean_and_begin_anew_after_a_delay(bench: Bench) -> None:
    def beats() -> int:
        return sum(kind is Kind.STATUS for kind, _ in bench.told)

    for _ in range(40):
        # Looked at late, by another part of a period each time.
        bench.now_s += 0.027
        bench.turn()
    assert beats() == pytest.approx(40 * 0.027 / BEAT_S, abs=1)
    before = beats()
    bench.now_s += BEAT_S + 0.045
    bench.turn()
    bench.turn()
    assert beats() == before + 1
    assert bench.engine.next_s >= bench.now_s + BEAT_S - 0.027
    assert bench.engine.status().stops == 0


def test_a_plan_that_wakes_a_stopped_engine_opens_nothing_by_itself(bench: Bench) -> None:
    bench.plan(1.0, 1.0, lease_s=2.0)
    waiting = SprayPlan(
        sequence=9, issued_s=bench.now_s, duty=(1.0, 1.0), changes=(),
        lease_until_s=bench.now_s + 2.0,
    )  # fmt: skip
    bench.now_s += 0.5
    bench.engine.receive(*unpack(pack_plan(waiting)))
    assert bench.valves == 0


def test_sleep_of_the_computer_is_a_standstill(bench: Bench) -> None:
    bench.plan(1.0, 1.0)
    bench.slept_s = 3600.0
    bench.turn()
    assert bench.valves == 0
    assert bench.engine.status().stops == 1


def test_a_short_delay_is_no_standstill(bench: Bench) -> None:
    bench.plan(1.0, 1.0)
    bench.now_s += GAP_S - 0.01
    bench.turn()
    assert bench.valves == 0b11
    assert bench.engine.status().stops == 0


def test_a_device_that_is_gone_is_a_fault_and_stays_one(bench: Bench) -> None:
    bench.plan(0.5, 0.5)
    bench.lines.broken = True
    bench.run(0.2)
    assert bench.engine.fault == "outputs cannot be written: the device is gone"
    assert bench.faults
    bench.lines.broken = False
    bench.run(0.1)
    assert bench.valves == 0
    bench.plan(1.0, 1.0)
    bench.run(0.1)
    assert bench.valves == 0
    assert not bench.engine.status().is_alive


def test_an_output_that_keeps_its_level_is_a_fault_that_names_its_line(bench: Bench) -> None:
    bench.lines.stuck = 0b10
    bench.plan(1.0, 1.0)
    bench.run(BEAT_S + 0.001)
    assert bench.engine.fault == "outputs do not take their level: 18"
    assert bench.valves == 0


def test_levels_are_read_back_at_the_start() -> None:
    stuck = Bench(wiring=Wiring(valves=(17,), normally_open=True))
    stuck.lines.levels, stuck.lines.stuck = 0, 1
    again = Engine(
        EngineSetup(wiring=stuck.wiring, pwm=PWM, backend="memory"),
        stuck.lines,
        clock=lambda: 0.0,
        boot_clock=lambda: 0.0,
        send=lambda packet: True,
    )
    assert again.fault == "outputs do not take their level: 17"


def refused(bench: Bench, plan: SprayPlan) -> str:
    before = bench.engine.rejected
    bench.submit(plan)
    assert bench.engine.rejected == before + 1
    return bench.engine.refusal


def test_plans_that_are_no_good_are_counted_and_the_last_one_goes_on(bench: Bench) -> None:
    bench.plan(1.0, 0.0)
    bench.sequence = 5
    bench.plan(1.0, 0.0)
    now_s = bench.now_s

    def plan(
        sequence: int = 7,
        issued_s: float = now_s,
        lease_s: float = 0.3,
        duty: tuple[float, ...] = (0.0, 1.0),
    ) -> SprayPlan:
        return SprayPlan(
            sequence=sequence,
            issued_s=issued_s,
            duty=duty,
            changes=(),
            lease_until_s=issued_s + lease_s,
        )

    assert refused(bench, plan(sequence=6)) == "out of order"
    assert refused(bench, plan(issued_s=now_s - 50.0)).startswith("made before")
    assert refused(bench, plan(issued_s=now_s + 0.1)) == "made in the future"
    assert refused(bench, plan(lease_s=2.6)) == "its lease is too long"
    assert refused(bench, plan(duty=(1.0,))) == "for another number of valves"
    bench.now_s += 0.05
    assert refused(bench, plan(lease_s=0.05)) == "its lease is over"
    bench.engine.receive(Kind.PLAN, b"nonsense")
    bench.engine.receive(Kind.READY, b"")
    assert bench.engine.rejected == 8
    bench.turn()
    assert bench.valves == 0b01
    bench.run(0.3)
    assert bench.valves == 0


def test_reports_wait_for_a_companion_that_does_not_read_and_are_dropped_at_last(
    bench: Bench,
) -> None:
    bench.listens = False
    bench.run(5.0, renew=(0.5, 0.5))
    assert bench.engine.status().dropped_reports == 0
    bench.run(120.0, renew=(0.5, 0.5))
    lost = bench.engine.status().dropped_reports
    assert lost == bench.engine.edges - 4096
    bench.listens = True
    bench.run(BEAT_S)
    assert len(bench.edges) == pytest.approx(4096, abs=10)


def test_reports_give_the_planned_and_the_actual_time(bench: Bench) -> None:
    bench.plan(1.0, 0.0, changes=(TimedChange(at_s=100.02, valve=0, duty=0.0),))
    bench.now_s = 100.023
    bench.turn()
    bench.run(0.05)
    off = [e for e in bench.edges if e.output == 0 and not e.is_open][-1]
    assert (off.planned_s, off.actual_s, off.duty) == (100.02, 100.023, 0.0)
    assert bench.engine.status().late == 1
    assert bench.engine.status().worst_late_us == pytest.approx(3000, abs=1)


def test_closing_writes_the_safe_levels_and_lets_go(bench: Bench) -> None:
    bench.plan(1.0, 1.0)
    bench.engine.close()
    assert bench.lines.levels == WIRING.safe_levels
    assert bench.lines.is_released


def test_closing_lets_go_of_a_device_that_is_gone(bench: Bench) -> None:
    bench.lines.broken = True
    with pytest.raises(OSError, match="gone"):
        bench.engine.close()
    assert bench.lines.is_released


def test_a_late_pulse_is_issued_whole_and_the_next_ones_come_back_to_their_places() -> None:
    bench = Bench(wiring=Wiring(valves=(17,)))
    bench.plan(0.5, lease_s=2.0)
    bench.run(0.2)
    # Over the pulse from 0.225 to 0.275, and the next begins at 0.325.
    bench.now_s = 100.285
    bench.turn()
    assert bench.lines.levels == 1
    bench.run(0.06)
    assert bench.lines.levels in (0, 1)
    bench.run(1.0)
    pulses = [edge for edge in bench.edges if edge.is_open]
    ends = [edge for edge in bench.edges if not edge.is_open and edge.duty > 0.0]
    late = next(k for k, edge in enumerate(pulses) if edge.actual_s - edge.planned_s > 0.05)
    assert ends[late].actual_s - pulses[late].actual_s == pytest.approx(0.95 * 0.05)
    assert pulses[late + 1].actual_s - ends[late].actual_s >= 0.01 - 1e-6
    assert pulses[late + 4].actual_s == pytest.approx(pulses[late + 4].planned_s)
    # None is missing: one a period.
    planned = [edge.planned_s for edge in pulses]
    assert all(b - a == pytest.approx(0.1, abs=0.003) for a, b in pairwise(planned))


def test_stop_packets_are_not_for_the_engine_itself(bench: Bench) -> None:
    bench.engine.receive(*unpack(pack(Kind.STOP)))
    assert bench.engine.rejected == 1

"""Without its record a flight does not begin to spray; one that has begun goes on for a while."""

from __future__ import annotations

import random
import shutil
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, cast

import pytest

from companion.core.types import Decision, HeartbeatReport, Inhibit, Input, SprayerState
from companion.journal import journal as journal_module
from companion.journal.journal import Journal
from companion.runtime import ControlLoop, NoRecorder
from tests.analysis.test_replay import inputs_of
from tests.builders import setup
from tests.companion.test_caught_ends import Scribe

STEPS = 60


@dataclass
class Flight:
    """A flight over the plots through the control loop; `fault` and age are the recorder's."""

    fault: str | None = None
    saved_age_s: float = 0.5
    now_s: float = 100.0
    told: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.scribe = Scribe()
        self.scribe.receive = self._receive  # type: ignore[method-assign]
        self.scribe.tell_fault = self.told.append  # type: ignore[method-assign]
        self._waiting: list[Input] = []
        self.loop = ControlLoop(
            setup(),
            link=self.scribe,
            executor=self.scribe,
            recorder=NoRecorder(),
            clock=lambda: self.now_s,
            boot_clock=lambda: self.now_s,
            required=(self, 60.0),
        )
        self._chance = random.Random(7)
        self._number = 0

    def _receive(self) -> list[Input]:
        inputs, self._waiting = self._waiting, []
        return inputs

    def fly(self, steps: int, *, armed: bool = True) -> list[Decision]:
        made = []
        for number in range(self._number, self._number + steps):
            inputs = list(inputs_of(number, setup(), self._chance))
            self._waiting += [
                replace(item, armed=armed) if isinstance(item, HeartbeatReport) else item
                for item in inputs
            ]
            self.now_s = 100.0 + number / 20 + 0.005
            made.append(cast(Decision, self.loop.turn()))
        self._number += steps
        return made


def is_spraying(decisions: list[Decision]) -> bool:
    return any(decision.sprayer is SprayerState.SPRAYING for decision in decisions)


def test_with_its_record_the_flight_sprays() -> None:
    assert is_spraying(Flight().fly(STEPS))


def test_without_its_record_nothing_is_opened_and_the_reason_is_told() -> None:
    flight = Flight(fault="database or disk is full")
    decisions = flight.fly(STEPS)
    assert all(Inhibit.OUTPUT_FAULT in decision.inhibits for decision in decisions)
    assert not any(decision.plan.opens for decision in decisions)
    assert flight.told == ["journal: database or disk is full"]


def test_a_flight_that_has_begun_goes_on_without_its_record() -> None:
    flight = Flight()
    assert is_spraying(flight.fly(60))
    flight.fault = "database or disk is full"
    later = flight.fly(20)
    assert is_spraying(later)
    assert not any(Inhibit.OUTPUT_FAULT in decision.inhibits for decision in later)


def test_in_flight_what_lasts_closes_and_both_are_told_once() -> None:
    flight = Flight()
    assert is_spraying(flight.fly(60))
    flight.fault = "only 3 MB are free"
    assert is_spraying(flight.fly(5))
    assert not flight.told
    flight.fault, flight.saved_age_s = "database or disk is full", 59.9
    assert is_spraying(flight.fly(20))
    (told,) = flight.told
    assert told.startswith("journal: database or disk is full") and "after 60 s" in told
    flight.saved_age_s = 60.1
    later = flight.fly(20)
    assert all(Inhibit.OUTPUT_FAULT in decision.inhibits for decision in later)
    assert not any(decision.plan.opens for decision in later)
    assert flight.told[1:] == ["journal: database or disk is full"]
    # It ends with the fault, and somebody has to answer first: no valve opens by itself.
    flight.fault, flight.saved_age_s = None, 0.5
    again = flight.fly(20)
    assert Inhibit.OUTPUT_FAULT not in again[-1].inhibits
    assert again[-1].sprayer is SprayerState.FAULT


def test_after_the_landing_the_record_counts_again() -> None:
    flight = Flight()
    assert is_spraying(flight.fly(60))
    flight.fault = "only 3 MB are free"
    landed = flight.fly(20, armed=False)
    assert Inhibit.OUTPUT_FAULT in landed[-1].inhibits


class Usage(NamedTuple):
    total: int
    used: int
    free: int


def wait_for(holds: object, fault: str, journal: Journal) -> None:
    """Wait until the journal's fault is the one; fail after ten seconds."""
    pause = threading.Event()
    for _ in range(1000):
        if journal.fault is not None and fault in journal.fault:
            return
        pause.wait(0.01)
    raise AssertionError(f"fault is {journal.fault!r}, not {fault!r} ({holds})")


def test_a_disk_that_fills_up_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: Usage(10**9, 10**9, 2_000_000))
    with Journal.create(
        tmp_path, setup=setup(), free_min_bytes=10**8, commit_every_s=0.02
    ) as journal:
        wait_for("space", "only 2 MB are free", journal)
        assert journal.free_bytes == 2_000_000
        assert 0.0 <= journal.saved_age_s < 60.0


def test_a_writer_that_stands_still_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "STALL_MAX_S", 0.05)
    with Journal.create(tmp_path, setup=setup()) as journal:
        wait_for("stall", "nothing was written for", journal)

"""A short flight for the tests of exports: two passes over four plots, one half beside them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from companion.core.controller import Memory, step
from companion.core.setup import Setup
from companion.core.types import PressureReport
from companion.journal.journal import Journal
from tests.analysis.report_flight import REAL
from tests.builders import along, flying, setup

START_S = 100.0
STEP_S = 0.05
SPEED_M_S = 5.0
# Where the passes are: on the second the right half of the boom is beside the plots, and two of
# its valves beyond the field's north border.
PASSES_M = ((3.0, 90.0), (5.99, 270.0))
PASS_STEPS = 260


def fly(
    folder: Path,
    *,
    training: str | None = None,
    facts: Mapping[str, str] | None = None,
    given: Setup | None = None,
) -> Path:
    """Return the journal of the flight."""
    used = setup() if given is None else given
    memory = Memory()
    with Journal.create(
        folder,
        setup=used,
        setup_text=facts,
        started_s=START_S,
        waits=True,
        simulated=REAL,
        training=training,
    ) as journal:
        number = 0
        for north_m, course in PASSES_M:
            for along_steps in range(PASS_STEPS):
                now_s = START_S + number * STEP_S
                flown_m = -8.0 + SPEED_M_S * STEP_S * along_steps
                east_m = flown_m if course == 90.0 else 48.0 - flown_m
                state = flying(now_s, east_m, north_m, **along(course))
                if number % 20 == 0:
                    pressure = PressureReport(received_s=now_s, pressure_kpa=300.0 + number)
                    journal.record_input(pressure)
                decision, memory = step(used, state, memory, now_s)
                journal.record_decision(decision)
                number += 1
            journal.record_event(now_s, "turn", f"after {number} decisions")
    return journal.path

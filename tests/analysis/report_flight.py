"""A short flight over four plots, for tests of reports: 48 m in ten seconds, and two turns."""

from __future__ import annotations

import json
import random
from pathlib import Path

from analysis.replay import FlownCore
from companion.journal.journal import Journal
from companion.simulated import Simulated
from tests.analysis.test_replay import inputs_of
from tests.builders import setup

REAL = Simulated(word="no", because="INS_ACC_ID 3408394 is a real sensor")
# All that the profile `eu` asks the operator for.
EU_TOLD: dict[str, object] = {
    "application.profile": "eu",
    "application.operator": "A. Grower",
    "application.parcel": "ES-41-17",
    "application.crop": "wheat",
    "application.crop_eppo": "TRZAW",
    "application.growth_stage_bbch": "31",
    "application.product_per_l": 0.05,
    "application.product_unit": "L",
    "product.name": "Mix 50",
    "product.registration": "ES-00123",
}


def fly(
    folder: Path,
    *,
    steps: int = 260,
    told: dict[str, object] | None = None,
    training: str | None = "no",
    simulated: Simulated = REAL,
    event: tuple[str, str] | None = None,
    enabled: bool = True,
) -> Path:
    """Return the journal of a flight that was closed in order."""
    given, chance = setup(), random.Random(7)
    core = FlownCore(given)
    about = {} if told is None else {"application_json": json.dumps(told)}
    with Journal.create(
        folder,
        setup=given,
        setup_text=about,
        started_s=100.0,
        waits=True,
        training=training,
        simulated=simulated,
    ) as journal:
        for number in range(steps):
            for item in inputs_of(number, given, chance):
                if not enabled and type(item).__name__ == "OperatorCommand":
                    continue
                journal.record_input(item)
                core.observe(item)
            journal.record_decision(core.decide(100.0 + number / 20))
        if event is not None:
            journal.record_event(100.0 + steps / 20, *event)
    return journal.path

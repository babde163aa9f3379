"""What drives the liquid runs while valves are measured: a pump that stands gives no flow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from analysis.calibrate_valves import measuring
from companion.cli import ground
from companion.config.motor_rules import atomisers_of, pump_of
from companion.ground.shell import GroundOutcome
from companion.ground.work import GroundKind, GroundTask, Phase
from tests.companion.test_motor_config import CONSTANT, PWM_VALVES, config


def test_pump_and_atomisers_run_as_in_flight_while_valves_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = config(tmp_path, *CONSTANT, text=PWM_VALVES)
    done: list[GroundTask] = []

    def perform(_config: object, _given: object, task: GroundTask, *_: Any, **__: Any) -> Any:
        done.append(task)
        return GroundOutcome(reasons=frozenset(), open_s=0.0, has_begun=False)

    monkeypatch.setattr(ground, "perform", perform)
    monkeypatch.setattr(ground, "ask", lambda *_: None)
    monkeypatch.setattr(ground, "listening", lambda _: 0)
    count = len(settings.valve)
    phases = (Phase(at_s=0.0, duty=(0.0,) * count), Phase(at_s=1.0, duty=(1.0,) * count))
    piece = GroundTask(kind=GroundKind.VALVES, phases=phases, seconds=2.0)
    measuring(settings, (), (), is_lines=False)(piece)
    (task,) = done
    pump, (atomiser, *_) = pump_of(settings), atomisers_of(settings)
    assert pump is not None
    assert task.drives[0] == pump.run_fraction > 0.0
    assert task.drives[1] == atomiser.fraction_for(6.0) > 0.0

"""A few flights of the fault campaign: the harness flies, strikes and judges."""

from __future__ import annotations

import pytest

from tests.bench.faults.cases import Kind, campaign
from tests.bench.faults.flight import fly
from tests.bench.faults.judge import judge

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300)]


@pytest.mark.parametrize(
    "only", ["SIGKILL both gpio", "STOP of the operator script", "SIGKILL companion dither"]
)
async def test_a_flight_sprays_and_closes(only: str) -> None:
    draw = next(campaign(1, 3, only=only))
    record = await fly(draw)
    assert any(one.to_s > record.path.reaches_s(0.0) for one in record.own)
    verdict = judge(record)
    # How soon is the campaign's affair: this computer may be busy.
    assert [text for text in verdict.wrong if "limit" not in text] == []
    assert record.own[-1].from_s < record.fault_s + 0.9
    assert Kind(str(verdict.kind)) is draw.case.kind

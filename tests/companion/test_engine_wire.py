from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.engine.wire import (
    CHANGES_MAX,
    PACKET_MAX,
    EngineSetup,
    Issued,
    Kind,
    RefusedError,
    Status,
    Wiring,
    edges_from,
    hazards,
    pack_edges,
    pack_plan,
    pack_status,
    plan_from,
    status_from,
    unpack,
)

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
PLAN = SprayPlan(
    sequence=7,
    issued_s=100.0,
    duty=(0.25, 1.0),
    changes=(
        TimedChange(at_s=100.1, valve=1, duty=0.0),
        TimedChange(at_s=100.2, valve=0, duty=0.5, restart=False),
    ),
    lease_until_s=100.3,
)


def test_a_plan_arrives_as_it_left() -> None:
    kind, body = unpack(pack_plan(PLAN))
    assert kind is Kind.PLAN
    assert plan_from(body) == PLAN


def test_reports_arrive_as_they_left() -> None:
    edges = [Issued(1.0, 1.25, 3, True, 0.35), Issued(2.0, 2.5, 24, False, 0.0)]
    assert edges_from(unpack(pack_edges(edges))[1]) == edges
    status = Status(at_s=1.5, sequence=9, accepted=3, worst_late_us=12, is_alive=True)
    assert status_from(unpack(pack_status(status))[1]) == status
    for read in (edges_from, status_from):
        with pytest.raises(RefusedError):
            read(b"x")


def test_the_setup_arrives_as_it_left() -> None:
    wiring = Wiring(valves=(17, 18), return_line=22, alive_line=4, normally_open=True)
    setup = EngineSetup(wiring=wiring, pwm=PWM, backend="spi595", device="/dev/spidev0.0")
    assert EngineSetup.from_bytes(setup.as_bytes()) == setup


@pytest.mark.parametrize("wrong", [b"", b"x" * 5, b"\0" * 40, b"x" * (PACKET_MAX + 1)])
def test_what_is_no_packet_is_refused(wrong: bytes) -> None:
    with pytest.raises(RefusedError):
        unpack(wrong)


def test_a_damaged_or_cut_packet_is_refused() -> None:
    packet = pack_plan(PLAN)
    for where in range(len(packet)):
        damaged = bytearray(packet)
        damaged[where] ^= 0x10
        try:
            kind, _ = unpack(bytes(damaged))
        except RefusedError:
            continue
        # The kind stands in the head: another one is another message, not this plan.
        assert kind is not Kind.PLAN
    for length in range(len(packet)):
        with pytest.raises(RefusedError):
            unpack(packet[:length])


def _with(form: str, where: int, value: float) -> bytes:
    """Return the body of the plan with another value at one place."""
    body = bytearray(unpack(pack_plan(PLAN))[1])
    struct.pack_into(form, body, where, value)
    return bytes(body)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.1, 1.1])
def test_a_duty_that_is_none_is_refused(value: float) -> None:
    first, change = 28, 28 + 16 + 8
    for where in (first, change):
        with pytest.raises(RefusedError):
            plan_from(_with("<d", where, value))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_none_is_refused(value: float) -> None:
    for where in (8, 16, 28 + 16):
        with pytest.raises(RefusedError):
            plan_from(_with("<d", where, value))


def test_changes_out_of_order_or_for_no_valve_are_refused() -> None:
    with pytest.raises(RefusedError, match="order"):
        plan_from(_with("<d", 28 + 16, 101.0))
    with pytest.raises(RefusedError, match="valve"):
        plan_from(_with("<H", 28 + 16 + 16, 2))


def test_a_plan_too_large_is_refused_at_both_ends() -> None:
    change = TimedChange(at_s=100.1, valve=0, duty=0.5)
    many = SprayPlan(
        sequence=1, issued_s=100.0, duty=(0.0,), changes=(change,) * 4097, lease_until_s=101.0
    )
    assert len(many.changes) > CHANGES_MAX
    with pytest.raises(RefusedError):
        pack_plan(many)
    with pytest.raises(RefusedError, match="at most"):
        plan_from(_with("<H", 26, 4097))
    with pytest.raises(RefusedError, match="length"):
        plan_from(_with("<H", 26, 1))


def test_each_output_needs_a_line_of_its_own() -> None:
    for wrong in (
        {"valves": ()},
        {"valves": (1, 1)},
        {"valves": (1,), "return_line": 1},
        {"valves": (1,), "alive_line": 1},
        {"valves": tuple(range(65))},
        {"valves": (-1,)},
    ):
        with pytest.raises(ValueError, match=r"line|outputs"):
            Wiring(**wrong)


@pytest.mark.parametrize(
    ("normally_open", "active_low", "shut"),
    [(False, False, 0), (False, True, 1), (True, False, 1), (True, True, 0)],
)
def test_safe_levels_follow_kind_and_driver(
    normally_open: bool, active_low: bool, shut: int
) -> None:
    wiring = Wiring(valves=(5, 6), normally_open=normally_open, active_low=active_low)
    assert wiring.safe_levels == 0b11 * shut
    assert wiring.level(0, is_open=True) is (shut == 0)


def test_the_return_valve_is_safe_when_open_and_alive_is_safe_when_low() -> None:
    closed = Wiring(valves=(5,), return_line=6, alive_line=7, return_normally_open=False)
    assert closed.safe_levels == 0b010
    idle = Wiring(valves=(5,), return_line=6, alive_line=7, normally_open=True, active_low=True)
    assert idle.safe_levels == 0b010


def test_hazards_name_what_death_leaves() -> None:
    closed = Wiring(valves=(5,), alive_line=7)
    assert hazards(closed, keeps_levels=False) == []
    assert "strict_gpiod" in hazards(closed, keeps_levels=True)[0]
    spraying = Wiring(valves=(5,), normally_open=True)
    found = " ".join(hazards(spraying, keeps_levels=False))
    assert "remove strict_gpiod" in found
    assert "ALIVE" in found
    assert "power" in found


@pytest.mark.parametrize(
    "wrong", [{"overrun_s": 1.0}, {"lease_max_s": 0.0}, {"spi_hz": 1}, {"backend": "usb"}]
)
def test_a_setup_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"must lie|no such"):
        EngineSetup(wiring=Wiring(valves=(1,)), pwm=PWM, **wrong)

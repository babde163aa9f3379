"""Every message that is read, every field at its extremes: nothing raises, no number is made up.

The messages come from the registry of decoders, so that a new one is never forgotten.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.controller import expected_coverage
from companion.core.inputs import AutopilotLiquid
from companion.core.options.drift import Drift
from companion.core.options.flow_meter import Detection
from companion.core.options.flow_trim import FlowTrim
from companion.core.options.lines import Lines
from companion.core.setup import Setup
from companion.core.types import SpeedReport, WindReport
from companion.journal.codec import decode, encode
from companion.link.codec import Codec
from companion.link.component import Component, ComponentOptions
from companion.link.messages import ParamValue
from companion.link.parameters import Parameters, known_parameters
from companion.output.autopilot_options import ServoOptions
from companion.output.servo import ServoExecutor
from tests.bench.bad_frames import READ, extreme_frames, packed, sealed
from tests.bench.gate_frames import Loop, Vehicle, long_setup

NOW_S = 100.0


def floats_in(item: object) -> Iterator[float]:
    if isinstance(item, float):
        yield item
    elif dataclasses.is_dataclass(item):
        for field in dataclasses.fields(item):
            yield from floats_in(getattr(item, field.name))
    elif isinstance(item, tuple):
        for each in item:
            yield from floats_in(each)


def heard() -> Codec:
    codec = Codec()
    codec.decode(
        Vehicle(long_setup()).pack(mavlink.MAVLink_heartbeat_message(2, 3, 129, 3, 4, 3)), 1.0
    )
    return codec


@pytest.mark.parametrize("message_id", READ)
def test_no_extreme_of_any_field_raises_or_becomes_a_number_that_is_none(message_id: int) -> None:
    codec = heard()
    for label, frame in extreme_frames(message_id):
        for message in codec.decode(frame, NOW_S):
            if isinstance(message, ParamValue):
                continue  # PX4 puts a whole number's bytes where the float would be
            found = list(floats_in(message))
            assert all(math.isfinite(value) for value in found), (label, message)


def whole_setup(*, with_lines: bool) -> Setup:
    """Return a set-up in which everything that is read is used."""
    return replace(
        long_setup(speed_check_required=True, rc_channel=7, accuracy_max_m=1.0),
        autopilot_liquid=AutopilotLiquid(flow_battery=0, tank_battery=1, tank_l=20.0),
        detection=Detection(),
        flow_trim=FlowTrim(),
        drift=Drift(fall_s=0.5),
        mission_braking_m_s2=2.5,
        lines=Lines(polylines=(((-10.0, 3.0), (500.0, 3.0)),)) if with_lines else None,
        record_coverage=True,
    )


def whole_component(sent: list[bytes], events: list[str]) -> Component:
    """Return a component whose every reader is at work."""

    def send(frame: bytes) -> bool:
        sent.append(frame)
        return True

    options = ComponentOptions(
        use_mission=True, need_mission=True, use_battery=True, watch_mission=True, use_imu=True
    )
    parameters = Parameters(known_parameters({"lag.on_s": 0.1}, tank_l=20.0))
    component = Component(options, send, parameters=parameters)
    component.outputs.listener = ServoExecutor(ServoOptions(channels=(1, 9)), component.order)
    component.on_event = lambda at_s, kind, text: events.append(f"{at_s} {kind} {text}")
    component.on_refilled = lambda litres: litres < 20.0
    return component


@pytest.mark.parametrize("autopilot", [3, 12])
@pytest.mark.parametrize("message_id", READ)
async def test_no_extreme_of_any_field_ends_the_loop_or_opens_a_valve_under_an_inhibit(
    message_id: int, autopilot: int
) -> None:
    setup = whole_setup(with_lines=autopilot == 12)
    vehicle = Vehicle(setup, begin_s=NOW_S)
    loop = Loop(setup, component=whole_component([], []))
    beat = mavlink.MAVLink_heartbeat_message(2, autopilot, 129, 3 if autopilot == 3 else 0, 4, 3)
    loop.turn(vehicle.pack(beat), NOW_S - 0.05)
    found = [frame for _, frame in extreme_frames(message_id)]
    at_once = 1 if autopilot == 3 else 20
    batches = [b"".join(found[at : at + at_once]) for at in range(0, len(found), at_once)]
    extremes = [b""] * 25 + batches
    for number, frame in enumerate(extremes):
        now_s = NOW_S + 0.05 * number
        data = b"".join(vehicle.said(number, now_s)) + (vehicle.enable() if number % 10 else b"")
        decision = loop.turn(data + frame, now_s)
        state = decision.state
        assert decode(encode(decision)) == decision or state is None or has_nan(state)
        if number % 10 == 0:
            expected_coverage(setup, loop.memory, state, now_s=now_s, cut_s=now_s + 0.5)
    assert loop.wrong == []
    assert loop.open_count > 0 or autopilot == 12


def has_nan(item: object) -> bool:
    return any(math.isnan(value) for value in floats_in(item))


def test_a_speed_that_is_no_number_is_missing_and_a_wind_too() -> None:
    speed = mavlink.mavlink_map[74]
    assert speed.msgname == "VFR_HUD"
    (told,) = heard().decode(
        sealed(74, packed(74, {"groundspeed": math.inf}), system_id=1, component_id=1), NOW_S
    )
    assert told == SpeedReport(received_s=NOW_S, ground_speed_m_s=None)
    for message_id, field in ((168, "speed"), (231, "wind_x"), (231, "wind_y")):
        frame = sealed(
            message_id, packed(message_id, {field: math.inf}), system_id=1, component_id=1
        )
        assert heard().decode(frame, NOW_S) == [WindReport(received_s=NOW_S, speed_m_s=None)]


def test_a_wind_from_nowhere_keeps_its_speed() -> None:
    payload = packed(168, {"speed": 4.0, "direction": math.inf})
    frame = sealed(168, payload, system_id=1, component_id=1)
    assert heard().decode(frame, NOW_S) == [WindReport(received_s=NOW_S, speed_m_s=4.0)]

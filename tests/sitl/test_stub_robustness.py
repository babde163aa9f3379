"""Whatever a peer sends, the stub goes on: heartbeats come and the clock of the flight runs."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.stub.ardupilot import COMMANDS
from sitl.stub.mission_items import FLOWN, MissionItem, item_message
from sitl.stub.protocol import dialect
from sitl.stub.px4 import COMMANDS as PX4_COMMANDS
from tests.sitl.stub_bench import Bench, mission

AWKWARD = st.sampled_from(
    [0.0, 1.0, -1.0, 3.0, 9.0, 33.0, 1500.0, 65536.0, 1e9, -1e9, math.nan, math.inf, -math.inf]
) | st.floats(width=32)
KNOWN = sorted({*COMMANDS, *PX4_COMMANDS})
AUTOPILOT = st.sampled_from(["ardupilot", "px4"])
WHOLE = st.integers(-(2**31), 2**31 - 1)


def quiet(autopilot: str, **options: Any) -> Bench:
    """A stub that streams nothing: on PX4 that would be most of the work."""
    bench = Bench(autopilot=autopilot, **options)
    bench.companion.channel.streams.clear()
    return bench


def still_alive(bench: Bench) -> None:
    before = len(bench.companion.of("HEARTBEAT"))
    bench.run(1.1)
    assert len(bench.companion.of("HEARTBEAT")) > before
    pose = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert math.isfinite(pose.east_m) and math.isfinite(pose.height_m)


ORDERS = st.lists(st.tuples(st.sampled_from(KNOWN), st.lists(AWKWARD, min_size=7, max_size=7)))


@given(ORDERS, AUTOPILOT)
@settings(max_examples=100)
def test_commands_with_any_parameters(
    orders: list[tuple[int, list[float]]], autopilot: str
) -> None:
    bench = quiet(autopilot, items=mission((0.0, 20.0)))
    for command, params in orders:
        bench.companion.command(command, *params)
        bench.run(0.1)
    still_alive(bench)


@given(st.lists(st.binary(max_size=300), max_size=20), AUTOPILOT)
@settings(max_examples=100)
def test_any_bytes(chunks: list[bytes], autopilot: str) -> None:
    bench = quiet(autopilot)
    for chunk in chunks:
        bench.autopilot.receive(bench.companion.channel, chunk, bench.now_s)
    still_alive(bench)


@given(st.data())
@settings(max_examples=60)
def test_missions_with_any_items(data: st.DataObject) -> None:
    item = st.builds(
        MissionItem,
        command=st.sampled_from(sorted(FLOWN)),
        param1=AWKWARD,
        param2=AWKWARD,
        x_e7=WHOLE,
        y_e7=WHOLE,
        z_m=AWKWARD,
    )
    items = [*mission()[:2], *data.draw(st.lists(item, max_size=5))]
    bench = quiet(data.draw(AUTOPILOT))
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, len(items)))
    for number, one in enumerate(items):
        bench.companion.say(item_message(one, number, current=False, to=(1, 1)))
    bench.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.companion.command(dialect.MAV_CMD_MISSION_START)
    bench.run(5.0)
    still_alive(bench)


@given(st.integers(0, 200), AWKWARD, AUTOPILOT)
@settings(max_examples=100)
def test_parameters_with_any_value(index: int, value: float, autopilot: str) -> None:
    bench = quiet(autopilot, items=mission((0.0, 10.0)))
    parameters = bench.autopilot.parameters
    name = parameters.name_at(index % len(parameters))
    assert name is not None
    kind = parameters.kind(name)
    set_it = dialect.MAVLink_param_set_message(1, 1, name.encode("ascii"), value, kind)
    bench.companion.say(set_it)
    bench.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.run(0.1)
    bench.companion.command(dialect.MAV_CMD_MISSION_START)
    bench.companion.request(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW)
    bench.run(2.0)
    still_alive(bench)

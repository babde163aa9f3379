"""Whatever a peer sends, the stub goes on: heartbeats come and the clock of the flight runs."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.stub.commands import HANDLERS as COMMANDS
from sitl.stub.mission_items import SUPPORTED, MissionItem, item_message
from sitl.stub.parameters import Parameters
from sitl.stub.protocol import dialect
from tests.unit.stub_bench import Bench, mission

AWKWARD = st.sampled_from(
    [0.0, 1.0, -1.0, 3.0, 9.0, 33.0, 1500.0, 65536.0, 1e9, -1e9, math.nan, math.inf, -math.inf]
) | st.floats(width=32)
KNOWN = sorted(COMMANDS)
WHOLE = st.integers(-(2**31), 2**31 - 1)


def still_alive(bench: Bench) -> None:
    before = len(bench.companion.of("HEARTBEAT"))
    bench.run(1.1)
    assert len(bench.companion.of("HEARTBEAT")) > before
    pose = bench.autopilot.flight.world.pose_at(bench.now_s)
    assert math.isfinite(pose.east_m) and math.isfinite(pose.height_m)


@given(st.lists(st.tuples(st.sampled_from(KNOWN), st.lists(AWKWARD, min_size=7, max_size=7))))
@settings(max_examples=100)
def test_commands_with_any_parameters(orders: list[tuple[int, list[float]]]) -> None:
    bench = Bench(items=mission((0.0, 20.0)))
    for command, params in orders:
        bench.companion.command(command, *params)
        bench.run(0.1)
    still_alive(bench)


@given(st.lists(st.binary(max_size=300), max_size=20))
@settings(max_examples=100)
def test_any_bytes(chunks: list[bytes]) -> None:
    bench = Bench()
    for chunk in chunks:
        bench.autopilot.receive(bench.companion.channel, chunk, bench.now_s)
    still_alive(bench)


@given(st.data())
@settings(max_examples=60)
def test_missions_with_any_items(data: st.DataObject) -> None:
    item = st.builds(
        MissionItem,
        command=st.sampled_from(sorted(SUPPORTED)),
        param1=AWKWARD,
        param2=AWKWARD,
        x_e7=WHOLE,
        y_e7=WHOLE,
        z_m=AWKWARD,
    )
    items = [*mission()[:2], *data.draw(st.lists(item, max_size=5))]
    bench = Bench()
    bench.companion.say(dialect.MAVLink_mission_count_message(1, 1, len(items)))
    for number, one in enumerate(items):
        bench.companion.say(item_message(one, number, current=False, to=(1, 1)))
    bench.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.companion.command(dialect.MAV_CMD_MISSION_START)
    bench.run(5.0)
    still_alive(bench)


@given(st.integers(0, len(Parameters()) - 1), AWKWARD)
@settings(max_examples=100)
def test_parameters_with_any_value(index: int, value: float) -> None:
    bench = Bench(items=mission((0.0, 10.0)))
    name = bench.autopilot.parameters.name_at(index)
    assert name is not None
    set_it = dialect.MAVLink_param_set_message(1, 1, name.encode("ascii"), value, 9)
    bench.companion.say(set_it)
    bench.companion.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.companion.command(dialect.MAV_CMD_MISSION_START)
    bench.run(3.0)
    still_alive(bench)

"""Outputs through either firmware: PX4's one order for all, what is checked, and what is said."""

from __future__ import annotations

import asyncio
import itertools
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.types import TimedChange
from companion.link import outputs
from companion.link.component import Component, ComponentOptions
from companion.link.encode import Encoder
from companion.link.outputs import ParameterReader
from companion.output.autopilot_guard import OutputGuard, px4_wiring, wanted_parameters
from companion.output.servo import ServoExecutor, ServoOptions
from tests.builders import now, plan

CHANNELS = (1, 2, 3)
OPTIONS = ServoOptions(channels=CHANNELS)


class Joint:
    """A way that gathers orders and sends all of them at once; may be down."""

    def __init__(self) -> None:
        self.values: dict[int, int] = {}
        self.sent: list[dict[int, int]] = []
        self.times_s: list[float] = []
        self.is_up = True
        self.said: list[str] = []
        self._news = asyncio.Event()

    def order(self, channel: int, pulse_us: int) -> bool:
        self.values[channel] = pulse_us
        return True

    def flush(self) -> bool:
        if self.is_up:
            self.sent.append(dict(self.values))
            self.times_s.append(now())
            self._news.set()
        return self.is_up

    async def until(self, done: Callable[[], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not done():
                self._news.clear()
                await self._news.wait()

    async def executor(self, options: ServoOptions = OPTIONS) -> ServoExecutor:
        """Return a running executor that has met PX4."""
        executor = ServoExecutor(options, self.order, flush=self.flush, say=self.said.append)
        await executor.start()
        executor.met(is_px4=True)
        self.sent.clear()
        self.times_s.clear()
        return executor


# ---------------------------------------------------------------------------- PX4's one order


def decoded(frames: list[bytes]) -> list[Any]:
    parser = mavlink.MAVLink(None)
    return [message for frame in frames for message in parser.parse_buffer(frame) or []]


def test_one_command_carries_all_six_values_and_nothing_unknown() -> None:
    frames: list[bytes] = []
    encoder = Encoder(system_id=7, component_id=191)

    def send(frame: bytes) -> bool:
        frames.append(frame)
        return True

    orders = outputs.ActuatorOrders(encoder, send, closed_us=1000, full_us=2000)
    assert orders.order(1, 1000)
    assert orders.order(3, 1500)
    assert orders.order(4, 1875)
    assert frames == []
    assert orders.flush()
    assert orders.flush()
    (command,) = decoded(frames)
    assert (command.get_type(), command.command) == ("COMMAND_LONG", 187)
    assert (command.target_system, command.target_component) == (7, 1)
    values = [getattr(command, f"param{number}") for number in range(1, 8)]
    # Closed is -1 also where there is no valve; the last one is the index of the set.
    assert values == [-1.0, -1.0, 0.0, 0.75, -1.0, -1.0, 0.0]


def test_there_is_no_seventh_actuator() -> None:
    encoder = Encoder(system_id=1, component_id=191)
    orders = outputs.ActuatorOrders(encoder, lambda _: True, closed_us=1000, full_us=2000)
    assert [orders.order(channel, 1500) for channel in (0, 7, 9)] == [False] * 3


def test_a_driver_that_is_closed_at_the_long_pulse_is_closed_at_plus_one() -> None:
    encoder = Encoder(system_id=1, component_id=191)
    orders = outputs.ActuatorOrders(encoder, lambda _: True, closed_us=1900, full_us=1100)
    assert [orders.value(pulse) for pulse in (1900, 1500, 1100, 2500)] == [1.0, 0.0, -1.0, 1.0]


@given(st.integers(-(2**31), 2**31 - 1).filter(lambda n: not _is_signalling(n)))
def test_a_whole_number_survives_where_px4_puts_it(number: int) -> None:
    (value,) = struct.unpack("<f", struct.pack("<i", number))
    assert outputs.px4_parameter_value(value, 6) == number
    assert outputs.px4_parameter_value(float(number), 9) == float(number)
    assert outputs.parameter_value(float(number), 6) == float(number)


def _is_signalling(number: int) -> bool:
    """Whether the bytes are a signalling NaN, which no processor keeps; above 2 139 095 040."""
    bits = number & 0x7FFFFFFF
    return 0x7F800000 < bits < 0x7FC00000


async def test_all_changes_of_one_instant_leave_in_one_order() -> None:
    way = Joint()
    executor = await way.executor()
    at_s = now() + 0.03
    changes = tuple(TimedChange(at_s=at_s, valve=valve, duty=0.5) for valve in range(3))
    executor.submit(plan(1, 0.0, 0.0, 0.0, changes=changes))
    await way.until(lambda: bool(way.sent))
    assert way.sent == [{1: 1500, 2: 1500, 3: 1500}]
    assert executor.lateness.worst_s == pytest.approx(way.times_s[0] - at_s, abs=2e-3)
    await executor.stop()
    assert way.sent[-1] == {1: 1000, 2: 1000, 3: 1000}


async def test_a_trim_that_waits_rides_with_the_next_order() -> None:
    way = Joint()
    executor = await way.executor()
    executor.submit(plan(1, 0.5, 0.5, 0.5))
    for number in range(2, 40):
        executor.submit(plan(number, 0.5 + 0.003 * (number % 2), 0.5, 0.5))
    # Eight commands at once are all that PX4's queue takes.
    assert len(way.sent) <= 6
    now_us = 1503 if way.sent[-1][1] == 1500 else 1500
    executor.submit(plan(50, (now_us - 1000) / 1000, 0.5, 0.5))
    assert way.sent[-1][1] != now_us
    executor.submit(plan(51, (now_us - 1000) / 1000, 0.0, 0.5))
    assert way.sent[-1] == {1: now_us, 2: 1000, 3: 1500}
    await executor.stop()


async def test_zones_are_never_withheld_and_said_again_where_the_queue_may_have_lost_them() -> None:
    way = Joint()
    executor = await way.executor(ServoOptions(channels=CHANNELS, refresh_s=10.0))
    for number in range(1, 13):
        executor.submit(plan(number, 0.5 if number % 2 else 0.0, 0.0, 0.0))
    assert [sent[1] for sent in way.sent] == [1500, 1000] * 6
    count = len(way.sent)
    await way.until(lambda: len(way.sent) > count)
    assert way.times_s[count] - way.times_s[count - 1] <= 0.5
    assert way.sent[-1] == {1: 1000, 2: 1000, 3: 1000}
    await executor.stop()


async def test_an_order_that_could_not_leave_is_given_with_the_next_plan() -> None:
    way = Joint()
    executor = await way.executor()
    executor.submit(plan(1, 0.5, 0.5, 0.5))
    way.is_up = False
    executor.submit(plan(2, 0.0, 0.0, 0.0))
    way.is_up = True
    executor.submit(plan(3, 0.0, 0.0, 0.0))
    assert way.sent[-1] == {1: 1000, 2: 1000, 3: 1000}
    await executor.stop()


async def test_arming_has_everything_said_anew() -> None:
    way = Joint()
    executor = await way.executor()
    executor.submit(plan(1, 0.0, 0.0, 0.0))
    way.sent.clear()
    executor.armed(True)
    assert way.sent == [{1: 1000, 2: 1000, 3: 1000}]
    executor.submit(plan(2, 0.5, 0.0, 0.0))
    executor.met(is_px4=True)  # a reboot
    assert way.sent[-1] == {1: 1500, 2: 1000, 3: 1000}
    await executor.stop()


async def test_all_valves_dither_in_one_order() -> None:
    way = Joint()
    executor = await way.executor(ServoOptions(channels=CHANNELS, dither_us=8))
    executor.submit(plan(1, 0.5, 0.6, 0.0))
    way.sent.clear()
    await way.until(lambda: len(way.sent) >= 3)
    assert way.sent[0] == {1: 1504, 2: 1604, 3: 1000}
    assert way.sent[1] == {1: 1496, 2: 1596, 3: 1000}
    await executor.stop()


async def test_wiring_that_px4_cannot_have_is_a_fault_in_one_line() -> None:
    way = Joint()
    executor = await way.executor(ServoOptions(channels=(9, 10)))
    assert executor.fault == "channel 9 on PX4: write the number of its actuator, 1 to 6"
    executor.submit(plan(1, 1.0, 1.0))
    assert {pulse for sent in way.sent for pulse in sent.values()} <= {1000}
    await executor.stop()
    many = px4_wiring(ServoOptions(channels=tuple(range(1, 9))))
    assert many is not None
    assert many.startswith("8 outputs, PX4 takes orders for 6")
    assert px4_wiring(ServoOptions(channels=(1, 2), return_channel=6)) is None


def report(**pulses: int) -> tuple[int, ...]:
    row = [0] * 16
    for name, pulse_us in pulses.items():
        row[int(name[1:]) - 1] = pulse_us
    return tuple(row)


async def test_px4_is_compared_only_while_it_is_armed() -> None:
    way = Joint()
    executor = await way.executor()
    known: dict[str, float | None] = dict.fromkeys(wanted_parameters(OPTIONS, is_px4=True))
    known |= {f"PWM_MAIN_FUNC{8 + n}": 300.0 + n for n in CHANNELS}
    more = executor.learned(known)
    assert "PWM_MAIN_DIS9" in more
    rest = {name: 900.0 if "_DIS" in name else None for name in more}
    assert executor.learned(rest) == ()
    disarmed = report(c9=900, c10=900, c11=900)
    for k in range(30):
        executor.reported(0, disarmed, now() + 1.0 + 0.1 * k)
    assert executor.fault is None
    executor.armed(True)
    # Disarmed again, though the heartbeat has not said so yet; and killed, where it lasts.
    for k in range(15):
        executor.reported(0, disarmed, now() + 1.0 + 0.1 * k)
        assert executor.fault is None
    for k in range(15, 20):
        executor.reported(0, disarmed, now() + 1.0 + 0.1 * k)
    assert executor.fault is not None
    assert executor.fault.startswith("actuator 1 reads 900 us, ordered 1000")
    await executor.stop()


def learned(executor: ServoExecutor, **pins: float | None) -> None:
    """Have the parameters read, of which PX4's simulation has no PWM_MAIN_DISn."""
    known: dict[str, float | None] = dict.fromkeys(wanted_parameters(OPTIONS, is_px4=True))
    known |= {f"PWM_MAIN_FUNC{8 + n}": 300.0 + n for n in CHANNELS}
    more = executor.learned(known)
    assert executor.learned(dict.fromkeys(more) | pins) == ()


async def test_disarming_is_no_fault_where_the_disarmed_value_is_not_known() -> None:
    way = Joint()
    executor = await way.executor()
    learned(executor)
    executor.armed(True)
    for k in range(15):  # the heartbeat says so up to a second later
        executor.reported(0, report(c9=900, c10=900, c11=900), now() + 1.0 + 0.1 * k)
        assert executor.fault is None
    executor.armed(False)
    executor.armed(True)
    for k in range(5):
        executor.reported(0, report(c9=1500, c10=1000, c11=1000), now() + 1.0 + 0.1 * k)
    assert executor.fault is not None  # what opens is a fault at once
    await executor.stop()


async def test_a_killed_output_is_still_a_fault_where_the_disarmed_value_is_not_known() -> None:
    way = Joint()
    executor = await way.executor()
    learned(executor)
    executor.armed(True)
    for k in range(25):
        executor.reported(0, report(c9=900, c10=900, c11=900), now() + 1.0 + 0.1 * k)
    assert executor.fault is not None
    await executor.stop()


async def test_that_no_output_is_told_is_not_said_while_parameters_are_read() -> None:
    said: list[str] = []
    guard = OutputGuard(OPTIONS, said.append)
    known: dict[str, float | None] = dict.fromkeys(guard.met(is_px4=True, now_s=0.0))
    known |= {f"PWM_MAIN_FUNC{8 + n}": 300.0 + n for n in CHANNELS}
    guard.armed(True, 0.0)
    guard.look(60.0)
    more = guard.learned(known)
    guard.look(70.0)
    assert said == []
    guard.learned(dict.fromkeys(more))
    said.clear()
    guard.look(71.0)
    guard.look(75.9)
    assert said == []
    guard.look(76.1)
    assert [text[:16] for text in said] == ["SERVO_OUTPUT_RAW"]


def test_parameters_are_read_at_a_pace_and_given_up_in_the_end() -> None:
    reader = ParameterReader()
    reader.want(["A", "B", "C"])
    asked: list[tuple[float, str]] = []
    for step in range(500):
        now_s = 0.01 * step
        name = reader.next_name(now_s)
        if name is not None:
            asked.append((now_s, name))
            if name != "B":
                reader.take(name, 5.0)
        known = reader.finished()
        if known is not None:
            break
    assert known == {"A": 5.0, "B": None, "C": 5.0}
    assert [name for _, name in asked] == ["A", "B", "C", "B", "B", "B"]
    assert all(b[0] - a[0] >= 0.039 for a, b in itertools.pairwise(asked))
    assert reader.finished() is None


# ------------------------------------------------------------------- the component as a whole


class Peer:
    """A component behind which an executor stands, and a vehicle that says what it is told to."""

    def __init__(self, autopilot: int) -> None:
        self.frames: list[bytes] = []
        self.component = Component(ComponentOptions(), self._send)
        self.orders: list[Any] = []
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.autopilot = autopilot

    def _send(self, frame: bytes) -> bool:
        self.frames.append(frame)
        return True

    def say(self, message: Any, at_s: float) -> None:
        self.component.receive(bytes(message.pack(self.mav)), at_s)
        self.mav.seq = (self.mav.seq + 1) % 256

    def beat(self, at_s: float, *, armed: bool = False) -> None:
        self.say(self.mav.heartbeat_encode(2, self.autopilot, 128 if armed else 0, 0, 3), at_s)

    def of(self, kind: str) -> list[Any]:
        return [message for message in decoded(self.frames) if message.get_type() == kind]


class Listener:
    """Takes down what it is told."""

    def __init__(self) -> None:
        self.heard: list[object] = []

    def met(self, is_px4: bool) -> tuple[str, ...]:
        self.heard.append(("met", is_px4))
        return ("PWM_MAIN_FUNC1",)

    def armed(self, is_armed: bool) -> None:
        self.heard.append(("armed", is_armed))

    def learned(self, known: dict[str, float | None]) -> tuple[str, ...]:
        self.heard.append(("learned", known))
        return ()

    def reported(self, port: int, pulse_us: Any, at_s: float) -> None:
        self.heard.append(("reported", port, pulse_us[8], at_s))


def test_px4_gets_its_own_orders_and_is_asked_for_its_own_parameters() -> None:
    peer, listener = Peer(12), Listener()
    peer.component.outputs.listener = listener
    answers: list[int] = []
    peer.component.on_order_ack = answers.append
    assert not peer.component.order(1, 1500)
    peer.beat(1.0)
    assert peer.component.order(1, 1500)
    assert [m.command for m in peer.of("COMMAND_LONG") if m.command in (183, 187)] == []
    assert peer.component.outputs.flush()
    assert [m.command for m in peer.of("COMMAND_LONG") if m.command in (183, 187)] == [187]
    peer.component.tick(None, 1.1)
    # One question of the outputs, and one whether the vehicle is simulated.
    (asked, _) = peer.of("PARAM_REQUEST_READ")
    assert (asked.param_id, asked.param_index, asked.target_component) == (
        "PWM_MAIN_FUNC1",
        -1,
        1,
    )
    (value,) = struct.unpack("<f", struct.pack("<i", 301))
    peer.say(peer.mav.param_value_encode(b"PWM_MAIN_FUNC1", value, 6, 100, 5), 1.2)
    peer.component.tick(None, 1.3)
    peer.beat(2.0, armed=True)
    peer.say(peer.mav.servo_output_raw_encode(0, 0, *range(1001, 1017)), 2.1)
    peer.say(peer.mav.command_ack_encode(187, 0, 0, 0, 1, 191), 2.2)
    assert listener.heard == [
        ("met", True),
        ("armed", False),
        ("learned", {"PWM_MAIN_FUNC1": 301.0}),
        ("armed", True),
        ("reported", 0, 1009, 2.1),
    ]
    assert answers == [0]


def test_after_a_reboot_the_outputs_are_met_again() -> None:
    peer, listener = Peer(3), Listener()
    peer.component.outputs.listener = listener
    peer.beat(1.0)
    # A restart is believed once its own clock goes on; one old position is a copy.
    for boot_ms, at_s in ((60_000, 1.1), *((2_000 + 50 * k, 5.0 + 0.05 * k) for k in range(40))):
        peer.say(peer.mav.global_position_int_encode(boot_ms, 1, 1, 1000, 1000, 0, 0, 0, 0), at_s)
    assert [entry for entry in listener.heard if entry == ("met", False)] == [("met", False)] * 2

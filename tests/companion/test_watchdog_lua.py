"""The watchdog script, run under Lua 5.3 with ArduPilot's bindings faked."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v10 import ardupilotmega as mavlink1
from pymavlink.dialects.v20 import ardupilotmega as mavlink2

from tests.lua_bindings import PARAMETERS, FakeAutopilot, message_of

VALVES = range(9, 15)
# What a valve may stay open after the last sign of life: the timeout and one run of the script.
CLOSES_MS = 320
WIRED: dict[str, float | None] = {"SPRW_FIRST": 9, "SPRW_LAST": 14}


def frame(
    name: bytes = b"SPR_LIVE",
    value: float = 1.0,
    *,
    system: int = 1,
    component: int = 191,
    version: int = 2,
    time_ms: int = 7,
) -> bytes:
    dialect = mavlink2 if version == 2 else mavlink1
    mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    return bytes(mav.named_value_float_encode(time_ms, name, value).pack(mav))


def heartbeat() -> bytes:
    mav = mavlink2.MAVLink(None, srcSystem=1, srcComponent=191)
    return bytes(mav.heartbeat_encode(18, 8, 0, 0, 4).pack(mav))


LIVE = frame()


def autopilot(
    parameters: dict[str, float | None] | None = None, *, boot_ms: int = 5_000, steps: int = 10_000
) -> FakeAutopilot:
    """Return one that has booted, with the script running."""
    one = FakeAutopilot(parameters={**WIRED, **(parameters or {})}, boot_ms=boot_ms, steps=steps)
    one.run(40)
    return one


def spray(one: FakeAutopilot, pulse_us: int = 1500) -> None:
    """Have the valves open with the leave of a sign of life."""
    one.on_message(LIVE)
    for channel in VALVES:
        one.order(channel, pulse_us)


def pulses(one: FakeAutopilot) -> list[int | None]:
    return [one.outputs_us.get(channel) for channel in VALVES]


CLOSED: list[int | None] = [1000] * 6
OPEN: list[int | None] = [1500] * 6


# ------------------------------------------------------------------------------------ timing


def test_closed_is_written_from_the_first_run() -> None:
    one = FakeAutopilot(parameters=WIRED)
    one.run(0)
    assert pulses(one) == CLOSED
    assert set(one.outputs_us) == set(VALVES)
    assert one.texts == ["Spray watchdog: started"]


def test_before_the_first_sign_of_life_no_order_lasts() -> None:
    one = autopilot()
    one.order(9, 1500)
    one.run(20)
    assert pulses(one) == CLOSED
    assert one.texts[-1] == "Spray watchdog: no sign of life, closed"


def test_signs_of_life_at_ten_hertz_leave_the_orders_alone() -> None:
    one = autopilot()
    spray(one)
    for _ in range(100):
        one.run(100)
        one.on_message(LIVE)
    assert pulses(one) == OPEN
    assert one.texts == ["Spray watchdog: started"]


@pytest.mark.parametrize("phase_ms", range(0, 20, 3))
def test_it_closes_within_one_run_after_the_timeout_and_not_before(phase_ms: int) -> None:
    one = autopilot()
    one.run(phase_ms)
    spray(one)
    one.run(299)
    assert pulses(one) == OPEN
    one.run(CLOSES_MS - 299)
    assert pulses(one) == CLOSED


def test_two_lost_signs_of_life_close_nothing() -> None:
    one = autopilot()
    spray(one)
    one.run(290)
    one.on_message(LIVE)
    one.run(290)
    assert pulses(one) == OPEN


def test_an_order_while_it_is_silent_lasts_one_run() -> None:
    one = autopilot()
    spray(one)
    one.run(1000)
    for _ in range(50):
        one.order(11, 2000)
        one.run(20)
        assert pulses(one) == CLOSED


def test_it_says_once_that_it_closed_and_once_that_life_is_back() -> None:
    one = autopilot()
    for _ in range(2):
        one.texts.clear()
        spray(one)
        one.run(5000)
        one.order(9, 1500)
        one.run(5000)
        assert one.texts == ["Spray watchdog: no sign of life, closed"]
        one.on_message(LIVE)
        one.run(100)
        one.on_message(LIVE)
        one.run(100)
        assert one.texts[1:] == ["Spray watchdog: sign of life is back"]
        one.run(300)


def test_an_end_of_spraying_is_no_news() -> None:
    one = autopilot()
    spray(one)
    one.run(50)
    spray(one, 1000)
    one.run(5000)
    assert one.texts == ["Spray watchdog: started"]


def test_it_opens_nothing_when_life_is_back() -> None:
    one = autopilot()
    spray(one)
    one.run(1000)
    for _ in range(20):
        one.on_message(LIVE)
        one.run(100)
    assert pulses(one) == CLOSED


def test_the_clock_may_wrap() -> None:
    one = autopilot(boot_ms=2**32 - 240)
    spray(one)
    one.run(299)
    assert pulses(one) == OPEN
    one.run(CLOSES_MS - 299)
    assert pulses(one) == CLOSED


def test_a_sign_of_life_does_not_grow_young_again_when_the_clock_comes_round() -> None:
    one = autopilot()
    spray(one)
    one.run(CLOSES_MS)
    one.stall(2.0**32 - CLOSES_MS)
    one.order(9, 1500)
    one.run(20)
    assert pulses(one) == CLOSED


def test_a_sign_of_life_counts_from_when_it_came_not_from_when_it_was_read() -> None:
    one = autopilot()
    spray(one)
    one.on_message(LIVE)
    one.stall(400)
    one.run(20)
    assert pulses(one) == CLOSED


def test_a_full_queue_is_read_to_its_end() -> None:
    one = autopilot()
    spray(one)
    one.run(290)
    for _ in range(24):
        one.on_message(frame(b"SPR_RATE"))
    one.on_message(LIVE)
    one.run(100)
    assert pulses(one) == OPEN
    assert one.error is None


# ---------------------------------------------------------------------------------- messages


FOREIGN = {
    "another component": frame(component=192),
    "the autopilot": frame(component=1),
    "another vehicle": frame(system=2),
    "a shorter name": frame(b"SPR_LIV"),
    "a longer name": frame(b"SPR_LIVE2"),
    "small letters": frame(b"spr_live"),
    "the name within": frame(b"XSPR_LIVE"),
    "zero": frame(value=0.0),
    "negative": frame(value=-1.0),
    "no number": frame(value=math.nan),
    "a heartbeat": heartbeat(),
}


@pytest.mark.parametrize("foreign", FOREIGN.values(), ids=FOREIGN.keys())
def test_what_is_no_sign_of_life_of_our_companion_keeps_nothing_open(foreign: bytes) -> None:
    one = autopilot()
    spray(one)
    for _ in range(4):
        one.run(100)
        one.on_message(foreign)
    assert pulses(one) == CLOSED


@pytest.mark.parametrize("version", [1, 2])
def test_both_versions_of_mavlink_are_heard(version: int) -> None:
    one = autopilot()
    spray(one)
    for _ in range(6):
        one.run(100)
        one.on_message(frame(version=version))
    assert pulses(one) == OPEN


def test_mavlink_2_cuts_the_zeros_at_the_end_and_the_script_puts_them_back() -> None:
    assert len(LIVE) == 10 + 16 + 2
    one = autopilot()
    # A parser that leaves the last message's bytes behind the payload.
    dirty = bytearray(message_of(LIVE))
    dirty[12 + 16 : 12 + 18] = b"XY"
    one._queue.append((dirty.decode("latin-1"), int(one.now_ms)))
    one.order(9, 1500)
    one.run(20)
    assert one.outputs_us[9] == 1500


def test_a_payload_that_ends_early_is_no_sign_of_life() -> None:
    one = autopilot()
    short = bytearray(message_of(LIVE))
    short[3] = 6
    one._queue.append((short.decode("latin-1"), int(one.now_ms)))
    one.order(9, 1500)
    one.run(20)
    assert pulses(one) == CLOSED
    assert one.error is None


# ------------------------------------------------------------------------------- parameters


def test_its_parameters_fit_the_protocol_and_have_their_defaults() -> None:
    one = FakeAutopilot()
    one.run(0)
    own = {name: value for name, value in one.parameters.items() if name.startswith("SPRW_")}
    assert own == {
        "SPRW_ENABLE": 1,
        "SPRW_COMPID": 191,
        "SPRW_SYSID": 0,
        "SPRW_FIRST": 0,
        "SPRW_LAST": 0,
        "SPRW_MASK": 0,
        "SPRW_CLOSED_US": 1000,
        "SPRW_TIMEOUT_MS": 300,
        "SPRW_RET_CH": 0,
        "SPRW_RET_US": 2000,
    }
    assert max(map(len, own)) <= 16


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"SPRW_FIRST": 0}, "set SPRW_FIRST and SPRW_LAST"),
        ({"SPRW_FIRST": 14, "SPRW_LAST": 9}, "set SPRW_FIRST and SPRW_LAST"),
        ({"SPRW_FIRST": math.nan}, "set SPRW_FIRST and SPRW_LAST"),
        ({"SPRW_FIRST": 9.5}, "set SPRW_FIRST and SPRW_LAST"),
        ({"SPRW_LAST": 33}, "set SPRW_FIRST and SPRW_LAST"),
        ({"SPRW_COMPID": 0}, "SPRW_COMPID must be 1 to 255"),
        ({"SPRW_SYSID": 300}, "SPRW_SYSID: no MAVLink system"),
        ({"MAV_SYSID": None}, "SPRW_SYSID: no MAVLink system"),
        ({"SPRW_CLOSED_US": 0}, "SPRW_CLOSED_US must be 500 to 2500"),
        ({"SPRW_CLOSED_US": math.nan}, "SPRW_CLOSED_US must be 500 to 2500"),
        ({"SPRW_CLOSED_US": 1000.5}, "SPRW_CLOSED_US must be 500 to 2500"),
        ({"SPRW_RET_CH": 40}, "SPRW_RET_CH or SPRW_RET_US wrong"),
        ({"SPRW_RET_CH": 3}, "SERVO3_FUNCTION must be 0"),
        ({"SERVO11_FUNCTION": 94}, "SERVO11_FUNCTION must be 0"),
        ({"SERVO14_FUNCTION": None}, "SERVO14_FUNCTION must be 0"),
    ],
)
def test_a_setting_that_cannot_work_refuses_arming_with_its_name(
    wrong: dict[str, float | None], text: str
) -> None:
    one = autopilot(wrong)
    assert one.arming_text == text
    assert f"Spray watchdog: {text}" in one.texts
    one.run(9_000)
    assert one.texts.count(f"Spray watchdog: {text}") == 1
    one.parameters |= {**PARAMETERS, **{key: value or 0.0 for key, value in WIRED.items()}}
    one.parameters |= {"SPRW_COMPID": 191, "SPRW_SYSID": 0, "SPRW_CLOSED_US": 1000}
    one.parameters |= {"SPRW_RET_CH": 0}
    one.run(1_000)
    assert one.arming_text is None


def test_motors_are_never_written() -> None:
    one = autopilot({"SPRW_FIRST": 1, "SPRW_LAST": 14, "SPRW_RET_CH": 2})
    one.run(5_000)
    assert set(one.outputs_us) == set(range(5, 15))
    assert one.arming_text == "SERVO1_FUNCTION must be 0"


def test_an_output_that_becomes_a_motor_in_flight_is_left_alone_within_a_second() -> None:
    one = autopilot()
    one.armed = True
    one.parameters["SERVO9_FUNCTION"] = 33
    one.run(1_000)
    one.order(9, 1700)
    one.run(100)
    assert pulses(one) == [1700, *CLOSED[1:]]


def test_older_firmware_calls_its_system_by_another_name() -> None:
    one = autopilot({"MAV_SYSID": None, "SYSID_THISMAV": 7})
    one.on_message(frame(system=7))
    one.order(9, 1500)
    one.run(200)
    assert one.outputs_us[9] == 1500


@pytest.mark.parametrize(
    ("given_ms", "used_ms"), [(1, 200), (250, 250), (5000, 1000), (math.nan, 300), (math.inf, 1000)]
)
def test_the_timeout_is_held_to_what_makes_sense(given_ms: float, used_ms: int) -> None:
    one = autopilot({"SPRW_TIMEOUT_MS": given_ms})
    spray(one)
    one.run(used_ms - 1)
    assert pulses(one) == OPEN
    one.run(21)
    assert pulses(one) == CLOSED


def test_the_mask_adds_outputs_that_are_not_in_a_row() -> None:
    one = autopilot({"SPRW_FIRST": 0, "SPRW_LAST": 0, "SPRW_MASK": 2**15 + 2**6})
    assert one.outputs_us == {7: 1000, 16: 1000}
    assert one.arming_text is None


def test_a_pump_in_the_mask_is_stopped_with_the_valves() -> None:
    one = autopilot({"SPRW_MASK": 1 << 14})
    spray(one)
    one.order(15, 1900)
    one.run(290)
    assert one.outputs_us[15] == 1900
    one.run(CLOSES_MS - 290)
    assert pulses(one) == CLOSED
    assert one.outputs_us[15] == 1000
    assert one.texts[-1] == "Spray watchdog: no sign of life, closed"


def test_a_pump_that_alone_runs_on_is_stopped_and_said() -> None:
    one = autopilot({"SPRW_FIRST": 20, "SPRW_LAST": 20, "SPRW_CLOSED_US": 950})
    one.on_message(LIVE)
    one.order(20, 1600)
    one.run(CLOSES_MS)
    assert one.outputs_us == {20: 950}
    assert one.texts[-1] == "Spray watchdog: no sign of life, closed"


def test_a_return_valve_opens_while_the_others_are_closed() -> None:
    one = autopilot({"SPRW_RET_CH": 15, "SPRW_RET_US": 1900})
    assert one.outputs_us[15] == 1900
    spray(one)
    one.order(15, 1000)
    one.run(200)
    assert one.outputs_us[15] == 1000
    one.run(200)
    assert one.outputs_us[15] == 1900


def test_settings_are_taken_while_disarmed_and_stand_still_in_flight() -> None:
    one = autopilot()
    one.armed = True
    changed = {"SPRW_CLOSED_US": 1900.0, "SPRW_FIRST": 0.0, "SPRW_ENABLE": 0.0}
    one.parameters |= changed
    spray(one)
    one.run(2_000)
    assert pulses(one) == CLOSED
    one.armed = False
    one.parameters |= {"SPRW_FIRST": 9.0, "SPRW_ENABLE": 1.0}
    one.run(1_000)
    assert pulses(one) == [1900] * 6


def test_a_closed_pulse_that_cannot_be_used_leaves_the_last_good_one() -> None:
    one = autopilot({"SPRW_CLOSED_US": 1100})
    one.parameters["SPRW_CLOSED_US"] = math.nan
    one.run(1_000)
    spray(one)
    one.run(CLOSES_MS)
    assert pulses(one) == [1100] * 6


def test_without_any_usable_closed_pulse_there_is_none_which_closes_a_driver_board() -> None:
    one = autopilot({"SPRW_CLOSED_US": 65536})
    spray(one)
    one.run(CLOSES_MS)
    assert pulses(one) == [0] * 6


def test_disabled_it_touches_nothing_and_lets_the_vehicle_arm() -> None:
    one = autopilot({"SPRW_ENABLE": 0, "SPRW_FIRST": 0})
    one.order(9, 1500)
    one.run(5_000)
    assert one.outputs_us == {9: 1500}
    assert one.arming_text is None
    assert one.texts == ["Spray watchdog: started"]


# ----------------------------------------------------------------------------------- trouble


def test_run_again_it_closes_until_the_next_sign_of_life() -> None:
    one = autopilot()
    spray(one)
    one.run(100)
    one.restart_scripts()
    one.run(0)
    assert pulses(one) == CLOSED
    spray(one)
    one.run(100)
    assert pulses(one) == OPEN
    one.run(300)
    assert pulses(one) == CLOSED
    assert one.error is None


def test_run_again_in_flight_it_reads_its_settings_once() -> None:
    one = autopilot()
    one.armed = True
    one.restart_scripts()
    one.order(9, 1500)
    one.run(0)
    assert pulses(one) == CLOSED
    one.parameters["SPRW_CLOSED_US"] = 1900
    one.run(2_000)
    assert pulses(one) == CLOSED


@pytest.mark.parametrize("binding", ["receive_chan", "millis", "get", "is_armed", "send_text"])
def test_a_binding_that_fails_closes_and_the_script_goes_on(binding: str) -> None:
    one = autopilot()
    spray(one)
    one.run(40)
    one.broken = {binding}
    for _ in range(25):
        one.on_message(LIVE)
        one.run(100)
    is_harmless = binding == "send_text"
    assert (pulses(one) == CLOSED) != is_harmless
    one.broken = set()
    spray(one)
    one.run(2_000)
    assert pulses(one) == CLOSED
    assert one.error is None


def test_a_failure_is_told_and_not_more_than_every_ten_seconds() -> None:
    one = autopilot()
    one.broken = {"receive_chan"}
    one.run(21_000)
    assert sum("receive_chan is broken" in text for text in one.texts) == 3
    assert one.error is None


def test_a_build_without_read_back_or_arming_check_is_watched_all_the_same() -> None:
    one = autopilot()
    one.broken = {"get_aux_auth_id"}
    spray(one)
    one.run(CLOSES_MS)
    assert pulses(one) == CLOSED
    assert one.error is None


def test_a_table_key_that_another_script_has_refuses_arming() -> None:
    one = FakeAutopilot(parameters=WIRED)
    one.keys[163] = "OTHER_"
    one.run(1_000)
    assert one.arming_text == "parameter table 163 is taken"
    assert one.error is None


def test_no_room_for_its_message_refuses_arming_and_keeps_closed() -> None:
    one = FakeAutopilot(parameters=WIRED)
    one.accepted, one.accepted_max = [76], 1  # another script was first
    one.run(40)
    assert one.arming_text == "no room for NAMED_VALUE_FLOAT"
    spray(one)
    one.run(20)
    assert pulses(one) == CLOSED


def test_with_all_outputs_and_a_full_queue_it_stays_below_the_time_limit() -> None:
    free: dict[str, float | None] = {f"SERVO{channel}_FUNCTION": 0 for channel in range(1, 33)}
    one = autopilot({"SPRW_FIRST": 1, "SPRW_LAST": 32, "SPRW_RET_CH": 32, **free}, steps=8_000)
    for _ in range(100):
        for _ in range(25):
            one.on_message(LIVE)
        one.run(20)
    one.run(1_000)
    assert one.error is None
    assert set(one.outputs_us.values()) == {1000, 2000}


# -------------------------------------------------------------------------------- the law

names = st.sampled_from([b"SPR_LIVE", b"SPR_RATE", b"SPR_LIV", b"", b"SPR_LIVE99"])
messages = st.builds(
    frame,
    names,
    st.sampled_from([1.0, 0.0, -1.0, math.nan, math.inf]),
    system=st.sampled_from([1, 2]),
    component=st.sampled_from([191, 192, 1]),
    version=st.sampled_from([1, 2]),
    time_ms=st.sampled_from([0, 1, 2**32 - 1]),
)
events = st.one_of(
    st.tuples(st.just("message"), messages),
    st.tuples(st.just("message"), st.just(LIVE)),
    st.tuples(st.just("raw"), st.binary(min_size=291, max_size=291)),
    st.tuples(st.just("order"), st.sampled_from([1500, 2000, 0, 65535])),
    st.tuples(st.just("arm"), st.booleans()),
    st.tuples(st.just("restart"), st.none()),
)


def is_sign(raw: bytes) -> bool:
    """Say by the protocol's own words whether the frame is a sign of life."""
    message = mavlink2.MAVLink(None).parse_buffer(raw) or mavlink1.MAVLink(None).parse_buffer(raw)
    (one,) = message
    return bool(
        (one.get_srcSystem(), one.get_srcComponent()) == (1, 191)
        and one.name == "SPR_LIVE"
        and one.value > 0
    )


@given(st.lists(st.tuples(events, st.integers(0, 400)), max_size=30), st.sampled_from([0, 2**32]))
@settings(max_examples=60)
def test_whatever_comes_all_is_closed_once_life_was_silent_for_the_timeout_and_one_run(
    stream: list[tuple[tuple[str, object], int]], wraps_at_ms: int
) -> None:
    one = autopilot(boot_ms=max(wraps_at_ms - 2_000, 0))
    last_ms = -math.inf
    for (kind, what), wait_ms in stream:
        if kind == "message" and isinstance(what, bytes):
            one.on_message(what)
            last_ms = one.now_ms if is_sign(what) else last_ms
        elif kind == "raw" and isinstance(what, bytes):
            noise = bytearray(what)
            noise[9:12] = struct.pack("<I", 251)[:3]
            noise[8] = 190  # noise of another sender: it may look like anything
            one._queue.append((noise.decode("latin-1"), int(one.now_ms)))
        elif kind == "order" and isinstance(what, int):
            for channel in VALVES:
                one.order(channel, what)
        elif kind == "arm":
            one.armed = bool(what)
        else:
            one.restart_scripts()
        one.run(wait_ms)
        ordered_ms = one.now_ms - wait_ms
        if one.now_ms - last_ms >= CLOSES_MS and one.now_ms - ordered_ms >= 20:
            assert pulses(one) == CLOSED
        assert one.error is None
    one.run(CLOSES_MS)
    assert pulses(one) == CLOSED

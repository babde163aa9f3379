"""The watchdog script in the stub autopilot: orders over the wire, outputs of the stub."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.stub.watchdog import Watched
from tests.lua_bindings import FakeAutopilot
from tests.sitl.stub_bench import Bench


def watched() -> tuple[Bench, FakeAutopilot]:
    bench = Bench()
    script = FakeAutopilot(
        set_output=bench.autopilot.set_output,
        parameters={"SPRW_FIRST": 9, "SPRW_LAST": 14},
        boot_ms=round(bench.now_s * 1000),
    )
    bench.autopilot.script = script
    bench.run(0.1)
    return bench, script


def live(bench: Bench) -> None:
    bench.companion.say(mavlink.MAVLink_named_value_float_message(0, b"SPR_LIVE", 1.0))


def last_us(bench: Bench, channel: int = 9) -> int:
    return next(order.pulse_us for order in reversed(bench.orders) if order.channel == channel)


def test_the_script_closes_the_stub_s_outputs_after_the_last_sign_of_life() -> None:
    bench, script = watched()
    assert last_us(bench) == 1000
    for _ in range(10):
        live(bench)
        assert bench.companion.command(183, 9, 1500) == 0
        bench.run(0.1)
    assert last_us(bench) == 1500
    heard_s = bench.now_s - 0.1
    bench.run(1.0)
    closed = next(o for o in bench.orders if o.at_s > heard_s and o.pulse_us == 1000)
    # The timeout, one run of the script, one step of the stub.
    assert 0.3 <= closed.at_s - heard_s <= 0.341
    assert script.error is None


def test_an_order_without_a_sign_of_life_is_undone() -> None:
    bench, _ = watched()
    assert bench.companion.command(183, 9, 1500) == 0
    bench.run(0.05)
    assert last_us(bench) == 1000


# ------------------------------------------------------------------------ as the stub tells it anew


def retold() -> Bench:
    bench = Bench(watched=Watched(channels=(9, 17), closed_us=1000, return_channel=15))
    bench.companion.say(mavlink.MAVLink_param_set_message(1, 1, b"SERVO_32_ENABLE", 1.0, 2))
    bench.run(0.1)
    return bench


def test_the_stubs_own_script_closes_as_the_real_one_does() -> None:
    bench = retold()
    assert last_us(bench, 15) == 2000
    for _ in range(10):
        live(bench)
        assert bench.companion.command(183, 9, 1500) == 0
        assert bench.companion.command(183, 17, 1500) == 0
        bench.run(0.1)
    assert (last_us(bench), last_us(bench, 17)) == (1500, 1500)
    heard_s = bench.now_s - 0.1
    bench.run(1.0)
    closed = next(o for o in bench.orders if o.at_s > heard_s and o.pulse_us == 1000)
    assert 0.3 <= closed.at_s - heard_s <= 0.341
    assert (last_us(bench), last_us(bench, 17)) == (1000, 1000)


def test_only_a_sign_of_life_of_our_companion_counts_and_the_parameter_ends_it() -> None:
    bench = retold()
    bench.companion.say(mavlink.MAVLink_named_value_float_message(0, b"SPR_LIVE", 0.0))
    bench.companion.say(mavlink.MAVLink_named_value_float_message(0, b"SPR_RATE", 1.0))
    assert bench.companion.command(183, 9, 1500) == 0
    bench.run(0.1)
    assert last_us(bench) == 1000
    bench.companion.say(mavlink.MAVLink_param_set_message(1, 1, b"SPRW_ENABLE", 0.0, 4))
    assert bench.companion.command(183, 9, 1500) == 0
    bench.run(1.0)
    assert last_us(bench) == 1500


def test_px4_has_no_script_and_ardupilot_none_unless_it_is_asked_for() -> None:
    assert Bench().autopilot.script is None
    assert "SPRW_ENABLE" not in Bench().autopilot.parameters
    assert Bench(autopilot="px4", watched=Watched(channels=(9,))).autopilot.script is None

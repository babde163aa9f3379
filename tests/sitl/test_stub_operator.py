"""The friendly operator waits, flies, enables until it is acknowledged, and lands."""

from __future__ import annotations

from typing import Any

from sitl.serve import Operator, Step
from sitl.stub.mission_items import AUTO, LAND, Phase
from sitl.stub.protocol import Listener, SigningKey, Speaker, dialect
from sitl.stub.scenario import Scenario
from tests.sitl.stub_bench import Bench, mission

ACK = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_DO_SPRAYER, 0, 0, 0, 255, 190)


class Flown:
    """A bench with its operator at work."""

    def __init__(self, *, enable: bool = True, land: bool = True) -> None:
        self.bench = Bench(items=mission((0.0, 60.0), land=land))
        self.operator = Operator(self.bench.autopilot, enable=enable)

    def run(self, duration_s: float) -> None:
        end_s = self.bench.now_s + duration_s
        while self.bench.now_s < end_s:
            self.bench.run(0.02)
            self.operator.tick(self.bench.now_s)

    def beat(self) -> None:
        self.bench.companion.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))

    def enables(self) -> list[Any]:
        return self.bench.companion.of("COMMAND_LONG")


def test_nothing_happens_without_a_companion() -> None:
    flown = Flown()
    flown.run(30.0)
    assert flown.operator.step is Step.WAITING
    assert not flown.bench.autopilot.flight.armed


def test_a_gimbals_heartbeat_is_no_companion() -> None:
    flown = Flown()
    gimbal = flown.bench.peer(1, 154)
    gimbal.say(dialect.MAVLink_heartbeat_message(26, 8, 0, 0, 4, 3))
    flown.run(10.0)
    assert flown.operator.step is Step.WAITING


def test_a_companion_is_flown_and_enabled_once_in_the_air() -> None:
    flown = Flown()
    flown.beat()
    flown.run(3.5)
    assert flown.bench.autopilot.flight.mode == AUTO
    assert not flown.enables()
    flown.run(3.0)
    assert flown.bench.autopilot.flight.phase is Phase.ROUTE
    order = flown.enables()[0]
    assert (order.get_srcSystem(), order.target_component, order.command, order.param1) == (
        *(255, 191),
        *(dialect.MAV_CMD_DO_SPRAYER, 1.0),
    )


def test_the_enable_is_repeated_until_it_is_acknowledged() -> None:
    flown = Flown()
    flown.beat()
    flown.run(8.0)
    repeated = len(flown.enables())
    assert repeated >= 3
    flown.bench.companion.say(ACK)
    flown.run(3.0)
    assert len(flown.enables()) == repeated
    assert flown.operator.enabled


def test_a_refused_enable_is_not_taken_for_one() -> None:
    flown = Flown()
    flown.beat()
    flown.run(6.0)
    refusal = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_DO_SPRAYER, 2, 0, 0, 255, 190)
    flown.bench.companion.say(refusal)
    assert not flown.operator.enabled


def test_the_enable_can_be_left_out() -> None:
    flown = Flown(enable=False)
    flown.beat()
    flown.run(60.0)
    assert flown.operator.step is Step.DONE
    assert not flown.enables()


def test_a_mission_without_landing_is_landed_by_hand() -> None:
    flown = Flown(land=False)
    flown.beat()
    flown.run(60.0)
    assert flown.bench.autopilot.flight.mode == LAND
    assert flown.operator.step is Step.DONE
    assert not flown.bench.autopilot.flight.armed


def test_a_vehicle_that_refuses_is_not_asked_at_every_moment() -> None:
    flown = Flown()
    flown.bench.autopilot.flight.set_items((), flown.bench.now_s)
    flown.beat()
    flown.run(14.0)
    assert flown.operator.step is Step.SETTLING
    assert len(flown.bench.companion.of("STATUSTEXT")) <= 8


def test_its_enable_is_signed_where_the_link_is() -> None:
    """A companion with the key set hears nobody who does not sign."""
    secret = bytes(range(1, 33))
    bench = Bench(scenario=Scenario(signing_key=secret), items=mission((0.0, 60.0)))
    frames: list[bytes] = []
    bench.companion.channel.send = frames.append
    operator = Operator(bench.autopilot, key=bench.autopilot.key)
    operator.hear(_beat(), bench.now_s)
    for _ in range(400):
        bench.run(0.02)
        operator.tick(bench.now_s)
    heard = Listener(SigningKey(secret=secret, timestamp=0)).messages(b"".join(frames))
    orders = [each for each in heard if each.get_type() == "COMMAND_LONG"]
    assert [order.command for order in orders[:1]] == [dialect.MAV_CMD_DO_SPRAYER]


def _beat() -> Any:
    beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    return Listener().messages(Speaker(1, 191).frame(beat))[0]

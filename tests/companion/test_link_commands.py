"""Commands to the component: every one is answered, and none does more than it may."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.core.controller import Memory, step
from companion.core.types import EstopReport, Input, OperatorCommand, RateOverride
from companion.link.component import Component, ComponentOptions
from companion.link.parameters import Parameters, known_parameters
from tests import builders
from tests.companion.component_peer import VEHICLE, Peer

SETUP = builders.setup()
OPEN, _ = step(SETUP, builders.SPRAYING, Memory(), 10.0)
CLOSED, _ = step(SETUP, None, Memory(), 10.0)
NAN, INF = float("nan"), float("inf")
ACCEPTED, FOR_NOW, DENIED, UNSUPPORTED = 0, 1, 2, 3


@pytest.fixture
def peer() -> Peer:
    return Peer()


@pytest.fixture
def component(peer: Peer) -> Component:
    made = Component(
        ComponentOptions(), peer.take, parameters=Parameters(known_parameters({}, tank_l=40.0))
    )
    made.receive(peer.heartbeat(), 0.0)
    peer.sent.clear()
    return made


def result(peer: Peer, component: Component, command: int, *params: float) -> int:
    """Return the result in the only answer to a command."""
    peer.sent.clear()
    component.receive(peer.command(command, *params), 1.0)
    (ack,) = peer.of("COMMAND_ACK")
    assert (ack.command, ack.target_system, ack.target_component) == (command, 255, 190)
    return int(ack.result)


EVERYONE = [{"to": 0}, {"system": 0}, {"system": 0, "to": 0}]
ESTOP = EstopReport(received_s=2.0, pressed=True, source="command")
DISABLE = OperatorCommand(received_s=2.0, enable=False, source="command")
ENABLED = replace(builders.SPRAYING, enabled=True)


@pytest.mark.parametrize("target", EVERYONE)
@pytest.mark.parametrize(("command", "meant"), [(216, DISABLE), (31014, ESTOP)])
def test_a_stop_that_is_said_to_everyone_is_taken_and_answered(
    peer: Peer, component: Component, target: dict[str, int], command: int, meant: object
) -> None:
    assert component.receive(peer.command(command, 0.0, **target), 2.0) == [meant]
    (ack,) = peer.of("COMMAND_ACK")
    assert (ack.command, ack.result) == (command, ACCEPTED)


@pytest.mark.parametrize("target", EVERYONE)
@pytest.mark.parametrize("value", [1.0, 0.5, NAN])
def test_nothing_but_a_stop_is_taken_from_what_is_said_to_everyone(
    peer: Peer, component: Component, target: dict[str, int], value: float
) -> None:
    assert component.receive(peer.command(216, value, **target), 2.0) == []
    assert component.receive(peer.command(31010, 90.0, **target | {"to": 0}), 2.0) == []


@pytest.mark.parametrize("target", [{"to": 1}, {"to": 190}, {"system": 8}, {"system": 8, "to": 0}])
def test_a_stop_that_is_said_to_somebody_else_is_not_ours(
    peer: Peer, component: Component, target: dict[str, int]
) -> None:
    for command in (216, 31014):
        assert component.receive(peer.command(command, 0.0, **target), 2.0) == []
    assert not peer.of("COMMAND_ACK")


def test_a_way_that_may_not_enable_is_denied_and_changes_nothing(peer: Peer) -> None:
    component = Component(ComponentOptions(may_enable=False), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    peer.sent.clear()
    assert component.receive(peer.command(216, 1.0), 2.0) == []
    assert peer.of("COMMAND_ACK")[0].result == DENIED
    assert component.receive(peer.command(216, 0.0), 2.0) == [DISABLE]
    component.tick(None, 2.1)
    assert peer.texts() == ["Spray: enable by command: see safety.enable_by"]


def enables(
    peer: Peer, component: Component, at_s: float, *, confirmation: int = 0, sequence: int = 0
) -> bool:
    """Return whether an ENABLE is taken; the answer has to say the same."""
    peer.sent.clear()
    data = peer.command(216, 1.0, confirmation=confirmation, sequence=sequence)
    inputs = component.receive(data, at_s)
    (ack,) = peer.of("COMMAND_ACK")
    assert (ack.result == ACCEPTED) is bool(inputs)
    assert ack.result in (ACCEPTED, FOR_NOW)
    return bool(inputs)


def test_a_retransmission_enables_where_the_first_was_lost(
    peer: Peer, component: Component
) -> None:
    assert enables(peer, component, 2.0, confirmation=1)


@pytest.mark.parametrize("stop", [216, 31014])
@pytest.mark.parametrize("to", [0, 191])
def test_a_retransmission_of_before_a_stop_enables_nothing(
    peer: Peer, component: Component, stop: int, to: int
) -> None:
    assert enables(peer, component, 2.0)
    component.receive(peer.command(stop, 0.0, to=to), 3.0)
    assert not enables(peer, component, 3.1, confirmation=1)
    assert not enables(peer, component, 32.9, confirmation=3)
    assert enables(peer, component, 33.1, confirmation=3)


def test_after_a_stop_a_new_command_enables_and_its_retransmission_is_answered_alike(
    peer: Peer, component: Component
) -> None:
    component.receive(peer.command(216, 0.0), 3.0)
    assert enables(peer, component, 3.1)
    assert enables(peer, component, 3.6, confirmation=1)


def test_a_retransmission_does_not_bring_back_what_the_pilot_took(
    peer: Peer, component: Component
) -> None:
    taken_back = replace(OPEN, state=replace(ENABLED, enabled=False))
    assert enables(peer, component, 2.0)
    component.tick(replace(OPEN, state=ENABLED), 2.1)
    component.tick(taken_back, 2.5)
    assert not enables(peer, component, 2.6, confirmation=1)
    assert enables(peer, component, 2.7)


@pytest.mark.parametrize("is_pressed_again", [False, True])
def test_a_commanded_stop_outlives_a_restart_until_somebody_disables(
    peer: Peer, tmp_path: Path, is_pressed_again: bool
) -> None:
    def started() -> Component:
        parameters = Parameters(stop_file=tmp_path / "state" / "stop.json")
        return Component(ComponentOptions(), peer.take, parameters=parameters)

    def after(component: Component, *commands: bytes) -> list[Input]:
        inputs = component.receive(peer.heartbeat(), 0.0)
        for at_s, command in enumerate(commands, start=1):
            inputs += component.receive(command, float(at_s))
        component.tick(CLOSED, 5.0)
        return [item for item in inputs if isinstance(item, EstopReport)]

    stop, disable = peer.command(31014), peer.command(216, 0.0)
    assert after(started()) == []
    assert len(after(started(), stop)) == 1
    again = (disable, stop) if is_pressed_again else ()
    assert after(started(), *again)[0] == EstopReport(
        received_s=0.0, pressed=True, source="command"
    )
    assert len(after(started(), peer.command(216, 1.0))) == 1  # an ENABLE does not end it
    assert len(after(started(), disable)) == 1
    assert after(started()) == []


def test_the_disk_is_not_waited_for_before_a_stop_has_closed(peer: Peer, tmp_path: Path) -> None:
    stop_file = tmp_path / "stop.json"
    component = Component(ComponentOptions(), peer.take, parameters=Parameters(stop_file=stop_file))
    component.receive(peer.heartbeat(), 0.0)
    component.receive(peer.command(31014), 1.0)
    component.tick(OPEN, 1.0)
    assert not stop_file.exists()
    component.tick(CLOSED, 1.05)
    assert stop_file.exists()


def test_a_copy_that_comes_late_enables_nothing_after_a_stop(
    peer: Peer, component: Component
) -> None:
    assert enables(peer, component, 2.0, sequence=254)
    component.receive(peer.command(216, 0.0, sequence=1), 2.5)
    for sequence in (254, 255, 0, 1):  # the same frame by another radio, or one that was lost
        assert not enables(peer, component, 3.0, sequence=sequence)
    assert enables(peer, component, 3.1, sequence=2)


def test_a_copy_of_an_order_in_integers_enables_nothing_after_a_stop(
    peer: Peer, component: Component
) -> None:
    enable = peer.ground("command_int", VEHICLE, 191, 0, 216, 0, 0, 1.0, 0, 0, 0, 0, 0, 0.0)
    assert len(component.receive(enable, 2.0)) == 1
    component.receive(peer.command(216, 0.0, sequence=1), 2.5)
    assert component.receive(enable, 2.6) == []


def test_an_order_in_integers_does_not_say_that_it_is_repeated_and_waits_after_a_stop(
    peer: Peer, component: Component
) -> None:
    def enabled(at_s: float) -> bool:
        order = peer.ground("command_int", VEHICLE, 191, 0, 216, 0, 0, 1.0, 0, 0, 0, 0, 0, 0.0)
        return bool(component.receive(order, at_s))

    assert enabled(2.0)
    component.receive(peer.command(216, 0.0), 3.0)
    assert not enabled(4.0)
    assert not enabled(12.9)
    assert enabled(13.1)


def test_a_very_late_copy_of_the_enable_that_was_taken_enables_nothing_after_a_stop(
    peer: Peer, component: Component
) -> None:
    assert enables(peer, component, 2.0, sequence=50)
    component.receive(peer.command(216, 0.0, sequence=51), 2.5)
    for sequence in range(52, 72):
        component.receive(peer.command(511, 0.0, sequence=sequence), sequence - 49.0)
    assert not enables(peer, component, 22.6, sequence=50)
    assert enables(peer, component, 22.7, sequence=72)


def test_a_station_that_begins_anew_is_late_for_a_moment_only(
    peer: Peer, component: Component
) -> None:
    component.receive(peer.command(216, 0.0, sequence=100), 2.0)
    assert not enables(peer, component, 2.5, sequence=5)
    assert enables(peer, component, 7.1, sequence=6)


def test_a_station_that_does_not_count_its_frames_is_never_late(
    peer: Peer, component: Component
) -> None:
    assert enables(peer, component, 2.0)
    component.receive(peer.command(216, 0.0), 2.1)
    assert enables(peer, component, 2.2)


@pytest.mark.parametrize("percent", [80.0, 95.0, 100.0, 110.0])
def test_a_rate_override_goes_to_the_core(peer: Peer, component: Component, percent: float) -> None:
    inputs = component.receive(peer.command(31010, percent), 2.0)
    assert inputs == [RateOverride(received_s=2.0, percent=percent)]
    assert peer.of("COMMAND_ACK")[0].result == ACCEPTED
    (value,) = peer.of("PARAM_VALUE")
    assert (value.param_id, value.param_value) == ("SPR_RATE_PCT", percent)


@pytest.mark.parametrize("percent", [79.99, 110.01, 0.0, -100.0, NAN, INF, -INF])
def test_a_rate_override_out_of_bounds_is_denied(
    peer: Peer, component: Component, percent: float
) -> None:
    assert component.receive(peer.command(31010, percent), 2.0) == []
    assert peer.of("COMMAND_ACK")[0].result == DENIED
    component.tick(None, 2.1)
    assert peer.texts() == ["Spray: rate override: 80 to 110 only"]


def test_a_command_that_comes_twice_is_done_once_and_answered_twice(
    peer: Peer, component: Component
) -> None:
    twice = [component.receive(peer.command(31010, 90.0), 2.0) for _ in range(2)]
    assert twice[0] == twice[1]
    assert len(peer.of("COMMAND_ACK")) == 2


def test_the_tank_is_known_from_the_first_filling_on(peer: Peer, component: Component) -> None:
    component.tick(OPEN, 10.0)
    assert peer.named("SPR_FLOW")
    assert not peer.named("SPR_TANK")
    component.tick(CLOSED, 10.1)
    assert result(peer, component, 31011, 0.0) == ACCEPTED
    for turn in range(601):
        component.tick(OPEN, 11.0 + turn * 0.1)
    assert OPEN.flow_l_min > 1.0
    assert peer.named("SPR_TANK")[0] == pytest.approx(40.0, abs=0.1)
    assert peer.named("SPR_TANK")[-1] == pytest.approx(40.0 - OPEN.flow_l_min, abs=0.1)


@pytest.mark.parametrize("litres", [40.1, -1.0, NAN, INF])
def test_a_filling_that_cannot_be_is_denied(
    peer: Peer, component: Component, litres: float
) -> None:
    assert result(peer, component, 31011, litres) == DENIED
    component.tick(CLOSED, 2.0)
    assert not peer.named("SPR_TANK")


def test_nobody_fills_the_tank_while_spraying(peer: Peer, component: Component) -> None:
    component.tick(OPEN, 10.0)
    assert result(peer, component, 31011, 0.0) == FOR_NOW


@pytest.mark.parametrize("command", [31012, 246])
def test_what_this_component_does_not_do_is_denied_with_a_text(
    peer: Peer, component: Component, command: int
) -> None:
    assert result(peer, component, command, 1.0) == DENIED
    component.tick(None, 2.0)
    assert len(peer.texts()) == 1


@pytest.mark.parametrize("command", [400, 183, 176, 31013, 0, 65535])
def test_everything_else_is_unsupported(peer: Peer, component: Component, command: int) -> None:
    assert result(peer, component, command, 1.0) == UNSUPPORTED


@pytest.mark.parametrize(
    ("message_id", "kind"),
    [
        (148.0, "AUTOPILOT_VERSION"),
        (22.0, "PARAM_VALUE"),
        (251.0, "NAMED_VALUE_FLOAT"),
        (0.0, "HEARTBEAT"),
        (253.0, "STATUSTEXT"),
    ],
)
def test_our_own_messages_can_be_asked_for(
    peer: Peer, component: Component, message_id: float, kind: str
) -> None:
    component.tick(CLOSED, 100.0)
    component.tick(CLOSED, 102.0)
    assert result(peer, component, 512, message_id) == ACCEPTED
    component.tick(CLOSED, 102.05)
    assert peer.of(kind)


@pytest.mark.parametrize(
    ("params", "expected"),
    [((33.0,), UNSUPPORTED), ((22.0, 99.0), DENIED), ((22.0, NAN), DENIED), ((NAN,), UNSUPPORTED)],
)
def test_messages_that_are_not_ours_cannot(
    peer: Peer, component: Component, params: tuple[float, ...], expected: int
) -> None:
    assert result(peer, component, 512, *params) == expected


def values_in_10_s(peer: Peer, component: Component, from_s: float) -> int:
    for turn in range(40):
        component.tick(CLOSED, from_s + turn * 0.05)
    peer.sent.clear()
    for turn in range(40, 240):
        component.tick(CLOSED, from_s + turn * 0.05)
    assert len(peer.of("HEARTBEAT")) == 10
    return len(peer.named("SPR_STATE"))


def test_the_rate_of_our_values_can_be_set_within_bounds(peer: Peer, component: Component) -> None:
    assert values_in_10_s(peer, component, 100.0) == 10
    assert result(peer, component, 511, 251.0, 250_000.0) == ACCEPTED
    assert values_in_10_s(peer, component, 200.0) == 40
    peer.sent.clear()
    component.receive(peer.command(510, 251.0), 220.0)
    assert [(m.message_id, m.interval_us) for m in peer.of("MESSAGE_INTERVAL")] == [(251, 250_000)]
    for interval_us in (1.0, -1.0, 1e9, NAN):
        assert result(peer, component, 511, 251.0, interval_us) == DENIED
    assert result(peer, component, 511, 251.0, 0.0) == ACCEPTED
    assert values_in_10_s(peer, component, 300.0) == 10


@pytest.mark.parametrize(("message_id", "expected"), [(0.0, DENIED), (33.0, UNSUPPORTED)])
def test_nobody_changes_our_signs_of_life(
    peer: Peer, component: Component, message_id: float, expected: int
) -> None:
    assert result(peer, component, 511, message_id, 1e6) == expected


def test_the_sign_of_life_keeps_its_rate_whatever_is_asked(
    peer: Peer, component: Component
) -> None:
    component.receive(peer.command(511, 251.0, 5e6), 0.0)
    for turn in range(60):
        component.tick(OPEN, turn * 0.05)
    assert 29 <= len(peer.named("SPR_LIVE")) <= 31


def test_the_version_can_be_asked_for_the_older_way(peer: Peer, component: Component) -> None:
    assert result(peer, component, 520, 1.0) == ACCEPTED
    (version,) = peer.of("AUTOPILOT_VERSION")
    assert version.capabilities & 2  # PARAM_FLOAT


def test_events_are_told_for_the_record(peer: Peer, component: Component) -> None:
    told: list[Any] = []
    component.on_event = lambda at_s, kind, text: told.append((at_s, kind, text))
    component.receive(peer.command(31010, 90.0, system=VEHICLE), 3.0)
    component.receive(peer.command(31011, 12.5), 4.0)
    assert told == [
        (3.0, "command", "rate override 90 %"),
        (4.0, "command", "refilled, tank 12.5 L"),
    ]


def test_the_record_says_who_enabled_disabled_and_released(peer: Peer) -> None:
    told: list[str] = []
    component = Component(ComponentOptions(page_may_enable=True), peer.take)
    component.on_event = lambda _at_s, kind, text: told.append(text) if kind == "consent" else None
    component.receive(peer.heartbeat(), 0.0)
    stopped = replace(ENABLED, enabled=False, estop=True)
    component.receive(peer.command(216, 1.0), 1.0)
    for state in (ENABLED, ENABLED):  # said once
        component.tick(replace(CLOSED, state=state), 1.1)
    component.obey_page("stop", None, 1.2)
    component.tick(replace(CLOSED, state=stopped), 1.3)
    component.obey_page("disable", None, 1.4)
    component.tick(replace(CLOSED, state=replace(stopped, estop=False)), 1.5)
    component.tick(replace(CLOSED, state=ENABLED), 1.6)
    component.tick(replace(CLOSED, state=replace(ENABLED, enabled=False)), 1.7)
    assert told == [
        "enabled by ground station 255/190",
        "disabled by the operator's page",
        "STOP released by the operator's page",
        "enabled by the RC switch",
        "disabled by switch, mode or disarming",
    ]

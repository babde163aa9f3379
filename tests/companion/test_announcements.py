"""What the component tells: reasons, notes, faults, values, sign of life."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.core.types import Decision, Inhibit, SprayPlan
from companion.link.announcer import reasons
from companion.link.component import Component
from tests.companion import component_peer
from tests.companion.component_peer import CLOSED, OPEN, Peer

peer, component, met = component_peer.peer, component_peer.component, component_peer.met


def inhibited(*inhibits: Inhibit) -> Decision:
    return replace(CLOSED, inhibits=frozenset(inhibits))


def test_reasons_are_told_when_they_change_and_not_otherwise(peer: Peer, met: Component) -> None:
    for turn in range(60):
        met.tick(inhibited(Inhibit.NOT_ENABLED, Inhibit.NOT_ARMED), turn * 0.05)
    for turn in range(60, 75):
        met.tick(OPEN, turn * 0.05)
    assert peer.texts() == ["Spray off: not enabled, not armed"]
    for turn in range(75, 110):
        met.tick(OPEN, turn * 0.05)
    assert peer.texts() == ["Spray off: not enabled, not armed", "Spray: ready"]


def test_reasons_that_flicker_are_told_now_and_then(peer: Peer, component: Component) -> None:
    for turn in range(1200):
        flicker = Inhibit.POSITION_FROZEN if turn % 12 > 5 else Inhibit.STALE_POSITION
        component.tick(inhibited(flicker), turn * 0.05)
    assert 1 <= len(peer.texts()) <= 3


def test_what_comes_and_goes_each_second_is_told_every_half_minute_and_arming_at_once(
    peer: Peer, component: Component
) -> None:
    # Positions once a second: held for longer than a change has to last, and loud ones among them.
    told_s = []
    for turn in range(20 * 120):
        now_s = turn * 0.05
        flicker = Inhibit.SPEED_DISAGREES if now_s % 2.6 > 1.2 else Inhibit.STALE_POSITION
        # Armed after a minute, and disabled at last: what is done by hand is told all the same.
        on_ground = {Inhibit.NOT_ARMED} if now_s < 60.0 else set()
        by_hand = {Inhibit.NOT_ENABLED} if now_s >= 100.0 else set()
        component.tick(inhibited(flicker, *on_ground, *by_hand), now_s)
        told_s += [now_s] * (len(peer.texts()) - len(told_s))
    assert sum(at_s > 10.0 for at_s in told_s) <= 4 + 2
    assert any(60.0 <= at_s <= 62.0 for at_s in told_s)
    assert any(100.0 <= at_s <= 102.0 for at_s in told_s)


def test_between_two_that_close_it_is_not_called_ready(peer: Peer, component: Component) -> None:
    for turn in range(20 * 60):
        now_s = turn * 0.05
        is_old = now_s % 2.4 > 1.2
        component.tick(inhibited(*([Inhibit.STALE_POSITION] if is_old else [])), now_s)
    assert peer.texts() == [*(["Spray: ready", "Spray off: position too old"] * 2)]


def test_what_was_unsteady_is_told_when_it_has_settled(peer: Peer, component: Component) -> None:
    for turn in range(20 * 80):
        now_s = turn * 0.05
        is_old = now_s < 30.0 and now_s % 2.4 > 1.2
        component.tick(inhibited(*([Inhibit.STALE_POSITION] if is_old else [])), now_s)
    assert peer.texts()[-1] == "Spray: ready"


def test_turns_of_a_flight_are_no_news_and_a_long_stand_is(
    peer: Peer, component: Component
) -> None:
    for turn in range(20 * 300):
        now_s = turn * 0.05
        slow = {Inhibit.SPEED_BELOW_MIN} if now_s % 20.0 > 15.0 else set()
        component.tick(inhibited(*slow), now_s)
    assert peer.texts() == ["Spray: ready"]
    for turn in range(20 * 12):
        component.tick(inhibited(Inhibit.SPEED_BELOW_MIN), 300.0 + turn * 0.05)
    assert peer.texts() == ["Spray: ready", "Spray off: too slow"]


def test_what_somebody_has_to_see_to_is_told_at_once(peer: Peer, met: Component) -> None:
    for turn in range(100):
        met.tick(OPEN, turn * 0.05)
    met.tick(inhibited(Inhibit.OUTPUT_FAULT), 5.0)
    assert peer.texts() == ["Spray: ready", "Spray off: output fault"]


def test_every_reason_is_said_in_plain_words() -> None:
    for inhibit in Inhibit:
        (line,) = reasons(frozenset({inhibit}))
        assert line.startswith("Spray off: ")
        assert len(line) <= 50
        assert "-" not in line


def test_all_reasons_at_once_are_two_lines_that_count_the_rest(peer: Peer, met: Component) -> None:
    met.tick(inhibited(*Inhibit), 0.0)
    texts = peer.texts()
    assert [text[:11] for text in texts] == ["Spray off: "] * 2
    assert all(len(text) <= 50 for text in texts)
    told = ", ".join(text[11:].rpartition(" +")[0] or text[11:] for text in texts).split(", ")
    names = [reasons(frozenset({inhibit}))[0][11:] for inhibit in Inhibit]
    assert ", ".join(told) in ", ".join(names)
    rest = int(texts[1].rpartition("+")[2])
    assert len(", ".join(told)) + len(", ".join(names[-rest:])) + 2 == len(", ".join(names))


def test_why_an_enabled_sprayer_is_closed_is_said_again_every_half_minute(
    peer: Peer, component: Component
) -> None:
    for turn in range(2 * 61):
        component.tick(inhibited(Inhibit.STALE_POSITION), turn * 0.5)
    assert peer.texts() == ["Spray off: position too old"] * 3
    peer.sent.clear()
    for turn in range(2 * 61):
        component.tick(inhibited(Inhibit.NOT_ENABLED), 100.0 + turn * 0.5)
    assert len(peer.texts()) == 1


def test_notes_are_told_slowly_and_no_more_than_a_few_wait(peer: Peer, met: Component) -> None:
    for number in range(100):
        met.receive(peer.command(216, 2.0 + number), 0.0)
        met.receive(peer.command(31010, 1.0), 0.0)
    met.tick(None, 0.0)
    assert len(peer.texts()) == 1
    for turn in range(200):
        met.tick(None, turn * 0.05)
    assert peer.texts() == ["Spray: DO_SPRAYER takes 0 or 1"]


def test_a_fault_is_told_once_as_an_error(peer: Peer, met: Component) -> None:
    met.fault("servo order failed")
    for turn in range(50):
        met.tick(OPEN, turn * 0.05)
    errors = [m.text for m in peer.of("STATUSTEXT") if m.severity == 3]
    assert errors == ["Spray: servo order failed"]


def test_values_are_told_once_a_second(peer: Peer, met: Component) -> None:
    for turn in range(60):
        met.tick(OPEN, turn * 0.05)
    assert len(peer.named("SPR_FLOW")) == 3
    assert peer.named("SPR_STATE") == [4.0] * 3
    assert peer.named("SPR_RATE")[0] == pytest.approx(20.0)


def test_the_sign_of_life_comes_ten_times_a_second_while_valves_may_be_open(
    peer: Peer, met: Component
) -> None:
    assert not OPEN.plan.is_off
    for turn in range(60):
        met.tick(OPEN, turn * 0.033)
    assert 19 <= len(peer.named("SPR_LIVE")) <= 21


def test_there_is_no_sign_of_life_while_everything_stays_closed(peer: Peer, met: Component) -> None:
    for turn in range(60):
        met.tick(CLOSED, turn * 0.05)
    assert not peer.named("SPR_LIVE")


def test_the_sign_of_life_comes_before_a_valve_opens(peer: Peer, met: Component) -> None:
    later = SprayPlan(
        sequence=1,
        issued_s=0.0,
        duty=(0.0,) * 6,
        changes=tuple(OPEN.plan.changes)[:1],
        lease_until_s=0.3,
    )
    met.tick(replace(OPEN, plan=later), 0.0)
    assert len(peer.named("SPR_LIVE")) == 1

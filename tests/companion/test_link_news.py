"""Switches and outputs that are told twice or late: old ones are not taken for news."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pytest

from companion.core.estimator import Track, observe
from companion.core.positions import PositionStream
from companion.core.types import Input, RcReport
from companion.link.component import Component, ComponentOptions, News
from companion.link.messages import ServoOutput
from tests import builders
from tests.companion.component_peer import Peer

UP_S = 300.0
PLAIN = builders.setup()
SETUP = replace(
    PLAIN,
    limits=replace(PLAIN.limits, rc_channel=7, enable_by=frozenset({"rc"})),
)


@pytest.fixture
def peer() -> Peer:
    return Peer()


@pytest.fixture
def component(peer: Peer) -> Component:
    made = Component(ComponentOptions(), peer.take)
    made.receive(peer.heartbeat(), 0.0)
    return made


def rc(peer: Peer, sent_s: float, pulse_us: int, *, up_s: float = UP_S) -> bytes:
    pulses = [1500] * 6 + [pulse_us] + [0] * 11
    return peer.autopilot("rc_channels", round((up_s + sent_s) * 1000), 8, *pulses, 254)


def enabled(inputs: Iterable[Input], track: Track) -> Track:
    for item in inputs:
        if isinstance(item, RcReport):
            track = observe(track, item, SETUP)
    return track


@pytest.mark.parametrize("late_s", [0.3, 3.0, 12.0])
def test_an_old_pulse_of_the_switch_does_not_enable_after_the_pilot_has_stopped(
    peer: Peer, component: Component, late_s: float
) -> None:
    track, sent = Track(), []
    for i in range(150):
        at_s = 0.2 * i
        up = 2.0 <= at_s < 15.0
        frame = rc(peer, at_s, 1900 if up else 1000)
        sent += [(at_s, frame), (at_s + late_s, frame)]
    for at_s, frame in sorted(sent):
        if round(at_s * 10) % 2 == 0:
            component.receive(peer.position(UP_S + at_s), at_s)
        track = enabled(component.receive(frame, at_s), track)
        assert track.consent.enabled is (2.0 <= at_s < 14.99), at_s


def test_after_a_restart_the_switch_counts_again_whatever_comes_late_of_before(
    peer: Peer, component: Component
) -> None:
    for i in range(20):
        component.receive(peer.position(UP_S + 0.1 * i), 0.1 * i)
        component.receive(rc(peer, 0.1 * i, 1000), 0.1 * i)
    for i in range(20):
        at_s = 10.0 + 0.1 * i
        component.receive(peer.position(1.0 + 0.1 * i), at_s)
        # Of before, by the slow radio.
        assert not component.receive(rc(peer, 0.1 * i, 1900), at_s) or i < 3
    assert component.receive(rc(peer, 12.0, 1900, up_s=-9.0), 12.0)


def outputs(boot_s: float | None, *, port: int = 0) -> ServoOutput:
    return ServoOutput(received_s=10.0, port=port, pulse_us=(1000,) * 16, boot_s=boot_s)


def test_an_old_output_is_no_fault_and_the_microseconds_begin_anew() -> None:
    news, order = News(), PositionStream()
    wrap_s = 2**32 / 1e6
    told = [(wrap_s - 1.0, 0), (wrap_s - 0.5, 0), (wrap_s - 1.0, 0), (wrap_s - 0.7, 1), (0.2, 0),
            (wrap_s - 0.1, 0), (0.2, 0), (0.3, 0)]  # fmt: skip
    seen = [news.is_old(outputs(boot_s, port=port), order) for boot_s, port in told]
    assert seen == [False, False, True, False, False, True, False, False]


def test_outputs_that_count_from_elsewhere_are_checked_all_the_same() -> None:
    news, order = News(), PositionStream(boot_s=300.0, received_s=10.0)
    assert not news.is_old(outputs(500.0), order)
    assert news.is_old(outputs(499.0), order)
    news.begin_anew(-10.0)
    assert news.is_old(outputs(500.0), order)
    news.begin_anew(-20.0)
    assert not news.is_old(outputs(500.0), order)


def test_what_has_no_time_is_news() -> None:
    news, order = News(), PositionStream(boot_s=3000.0, received_s=10.0)
    assert not news.is_old(outputs(3000.0), order)
    assert not news.is_old(outputs(None), order)
    assert not news.is_old(RcReport(received_s=10.0, pulse_us=()), order)

"""Supervision of the streams: answers used, fights told once, slow-downs waited out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from companion.link.announcer import lines
from companion.link.streams import Stream, StreamRequest, StreamSupervisor, wanted_streams

STREAMS = wanted_streams(position_rate_hz=20.0, is_px4=False)
WATCHED = [stream for stream in STREAMS if not stream.optional]
REFUSED, ACCEPTED = 2, 0
Share = Callable[[int, float], float]


class Bench:
    """An autopilot whose streams come at a share of what was asked for, and the supervisor."""

    def __init__(self, streams: Sequence[Stream] = STREAMS, *, may_group: bool = True) -> None:
        self.streams = streams
        self.supervisor = StreamSupervisor(may_group=may_group)
        self.counts: dict[int, float] = {}
        self.requests: list[tuple[float, StreamRequest]] = []
        self.texts: list[str] = []
        self.now_s = 0.0
        self.supervisor.start(streams, 0.0)

    def run(self, duration_s: float, share: Share) -> None:
        for _ in range(round(duration_s / 0.05)):
            self.now_s += 0.05
            for stream in self.streams:
                number = stream.message_id
                step = 0.05 * stream.rate_hz * share(number, self.now_s)
                self.counts[number] = self.counts.get(number, 0.0) + step
            whole = {number: int(count) for number, count in self.counts.items()}
            for request in self.supervisor.due(whole, self.now_s):
                self.requests.append((self.now_s, request))
            text = self.supervisor.trouble()
            if text is not None:
                self.texts.append(text)

    def asked(self) -> set[int]:
        return {request.stream.message_id for _, request in self.requests}


def test_streams_at_their_rate_are_left_alone() -> None:
    bench = Bench()
    bench.run(60.0, lambda number, now_s: 1.0)
    assert not bench.requests
    assert not bench.texts


@pytest.mark.parametrize(
    ("use_switch", "texts"), [(False, []), (True, ["not sent as asked: RC_CHANNELS"])]
)
def test_a_missing_receiver_is_told_where_a_switch_needs_it(
    use_switch: bool, texts: list[str]
) -> None:
    # PX4 sends no RC_CHANNELS without a receiver.
    bench = Bench(wanted_streams(position_rate_hz=20.0, is_px4=True, with_switch=use_switch))
    bench.run(60.0, lambda number, now_s: float(number != 65))
    assert bench.texts == texts


def test_a_quarter_of_everything_is_a_transfer_and_waited_out() -> None:
    bench = Bench()
    bench.run(10.0, lambda number, now_s: 1.0)
    bench.run(25.0, lambda number, now_s: 0.25)
    assert {number for number in bench.asked() if number in (33, 74, 36)} == set()
    bench.run(20.0, lambda number, now_s: 1.0)
    assert not bench.texts


def test_a_quarter_that_does_not_end_is_asked_about() -> None:
    bench = Bench()
    bench.run(5.0, lambda number, now_s: 1.0)
    bench.run(45.0, lambda number, now_s: 0.25)
    assert 33 in bench.asked()
    assert min(at_s for at_s, _ in bench.requests) > 30.0


def test_a_quarter_of_one_stream_only_is_asked_about_at_once() -> None:
    bench = Bench()
    bench.run(5.0, lambda number, now_s: 1.0)
    bench.run(6.0, lambda number, now_s: 0.25 if number == 33 else 1.0)
    assert bench.asked() == {33}


def test_another_station_that_sets_the_rates_is_told_once() -> None:
    bench = Bench()
    bench.run(200.0, lambda number, now_s: 0.4 if number == 33 and now_s % 20 > 10 else 1.0)
    assert bench.texts == ["another station changes our stream rates"]
    assert bench.asked() == {33}


def test_streams_that_never_come_are_told_in_one_line() -> None:
    bench = Bench()
    bench.run(120.0, lambda number, now_s: 0.0)
    (text,) = bench.texts
    assert text == "not sent as asked: GLOBAL_POSITION_INT VFR_HUD GPS_RAW_INT ..."
    assert len(lines(text)) == 2


@pytest.mark.parametrize("may_group", [True, False])
def test_a_refusal_leads_to_the_older_way_at_once_where_there_is_one(may_group: bool) -> None:
    bench = Bench(may_group=may_group)
    for _ in STREAMS:
        bench.supervisor.answered(REFUSED, 0.1)
    bench.run(9.0, lambda number, now_s: 0.0)
    assert {request.by_group for _, request in bench.requests} == {may_group}


def test_a_refusal_of_what_comes_nevertheless_changes_nothing() -> None:
    bench = Bench()
    for _ in STREAMS:
        bench.supervisor.answered(REFUSED, 0.1)
    bench.run(20.0, lambda number, now_s: 1.0)
    assert not bench.requests
    assert not bench.texts


def test_a_late_refusal_and_answers_too_many_are_ignored() -> None:
    bench = Bench()
    for _ in range(100):
        bench.supervisor.answered(REFUSED, 5.0)
    bench.run(9.0, lambda number, now_s: 0.0)
    assert {request.by_group for _, request in bench.requests} == {False}


def test_a_reboot_begins_anew_but_is_not_told_again() -> None:
    bench = Bench()
    bench.run(60.0, lambda number, now_s: 0.0)
    bench.supervisor.start(STREAMS, bench.now_s)
    bench.run(60.0, lambda number, now_s: 0.0)
    assert len(bench.texts) == 1

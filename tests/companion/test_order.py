"""Copies are dropped and restarts are believed: positions that come twice, late, or from zero."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.estimator import Track, estimate, observe
from companion.core.positions import Arrival, PositionStream, noted, sorted_in
from companion.core.safety import Consent
from companion.core.types import ClockReport, HeartbeatReport, Input, Telemetry, UtcReport
from tests import builders
from tests.builders import setup

SETUP = setup()
ONE = builders.position(0.0, 0.0, 3.0)
UP_S = 300.0  # how long the autopilot has been running at time 0
UTC_S = 1.8e9
HZ = 10.0


def position(sent_s: float, *, late_s: float = 0.0, boot_s: float | None = None) -> Telemetry:
    """Return where the vehicle is at `sent_s`, eastwards at 5 m/s."""
    boot_s = UP_S + sent_s if boot_s is None else boot_s
    latitude, longitude = SETUP.frame.to_geographic(5.0 * sent_s, 3.0)
    return replace(
        ONE,
        received_s=sent_s + late_s,
        boot_s=round(boot_s, 3),
        latitude_deg=latitude,
        longitude_deg=longitude,
    )


def stream(begin_s: float, end_s: float, *, late_s: float = 0.0) -> list[Telemetry]:
    count = round((end_s - begin_s) * HZ)
    return [position(begin_s + i / HZ, late_s=late_s) for i in range(count)]


def restarted(at_s: float, end_s: float, *, boot_s: float) -> list[Telemetry]:
    """Return positions whose clock was at `boot_s` at `at_s`."""
    count = round((end_s - at_s) * HZ)
    return [position(at_s + i / HZ, boot_s=boot_s + i / HZ) for i in range(count)]


def arrived(items: Iterable[Input]) -> list[Input]:
    return sorted(items, key=lambda item: item.received_s)


def sort(
    items: Iterable[Input], order: PositionStream | None = None
) -> tuple[PositionStream, list[Arrival]]:
    order, places = order or PositionStream(), []
    for item in arrived(items):
        if isinstance(item, Telemetry):
            order, place = sorted_in(order, item)
            places.append(place)
        else:
            order = noted(order, item)
    return order, places


def beat(now_s: float, *, armed: bool) -> HeartbeatReport:
    return HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=armed, mode="AUTO")


def exchange(now_s: float, boot_s: float) -> ClockReport:
    """Return an exchange that finds the autopilot's clock at `boot_s` at `now_s`."""
    return ClockReport(received_s=now_s, offset_s=now_s - boot_s, round_trip_s=0.01)


COPIES = {
    "half a second late": stream(0.0, 20.0, late_s=0.52),
    "two seconds late": stream(0.0, 20.0, late_s=2.03),
    "ten seconds late": stream(0.0, 20.0, late_s=10.0),
    "a router's loop": [
        item for late_s in (0.05, 0.7, 1.3, 3.1, 9.9) for item in stream(0.0, 20.0, late_s=late_s)
    ],
}


@pytest.mark.parametrize("name", COPIES)
def test_copies_are_dropped_and_change_nothing(name: str) -> None:
    clean: Sequence[Input] = stream(0.0, 20.0)
    plain, mixed = Track(), Track()
    for item in clean:
        plain = observe(plain, item, SETUP)
    for item in (item for item in arrived([*clean, *COPIES[name]]) if item.received_s < 20.0):
        mixed = observe(mixed, item, SETUP)
        state = estimate(mixed, item.received_s)
        assert state is not None
        assert state.clock_agrees
        assert state.position_valid or item.received_s < 0.6
    assert mixed._replace(order=plain.order) == plain


def test_the_slow_radio_alone_is_no_restart_and_its_positions_are_old() -> None:
    # The quick one falls silent at 10 s; the slow one goes on, three seconds late.
    _, places = sort([*stream(0.0, 10.0), *stream(0.0, 40.0, late_s=3.0)])
    assert Arrival.ANEW not in places
    track = Track(consent=Consent(enabled=True))
    for item in arrived([*stream(0.0, 10.0), *stream(0.0, 40.0, late_s=3.0)]):
        track = observe(track, item, SETUP)
        state = estimate(track, item.received_s)
        assert state is not None
        if item.received_s > 11.0:
            assert item.received_s - state.position_received_s > 0.8


def test_a_restart_is_believed_from_its_third_position_on() -> None:
    silent_s = 8.0
    _, places = sort([*stream(0.0, 10.0), *restarted(10.0 + silent_s, 20.0, boot_s=7.5)])
    assert places[100:] == [Arrival.AGAIN, Arrival.AGAIN, Arrival.ANEW, *[Arrival.NEXT] * 17]


def test_a_restart_is_believed_among_late_copies_of_before() -> None:
    late = [item for item in stream(0.0, 10.0, late_s=9.0) if item.received_s > 10.0]
    loop = [item for item in stream(0.0, 10.0, late_s=9.47) if item.received_s > 10.0]
    order, places = sort([*stream(0.0, 10.0), *late, *loop, *restarted(17.0, 30.0, boot_s=6.0)])
    assert places.count(Arrival.ANEW) == 1
    assert order.boot_s == pytest.approx(18.9)


def test_a_counter_of_32_bits_begins_anew() -> None:
    end_s = 2**32 / 1000.0
    items = [
        *(position(i / HZ, boot_s=end_s - 5.0 + i / HZ) for i in range(50)),
        *restarted(5.0, 8.0, boot_s=0.0),
    ]
    order, places = sort([*items, exchange(5.15, end_s + 0.15)])
    assert places[52] is Arrival.ANEW
    assert order.boot_s == pytest.approx(2.9)


BACK = restarted(10.0, 16.0, boot_s=UP_S - 40.0)  # set back by fifty seconds, and it stays so


@pytest.mark.parametrize(
    ("evidence", "is_believed"),
    [
        ([], False),
        ([exchange(10.15, UP_S - 40.0 + 0.15)], True),
        ([exchange(10.15, UP_S + 10.15)], False),  # it contradicts
        ([exchange(9.9, UP_S - 40.0 - 0.1)], False),  # of before
        ([UtcReport(received_s=10.15, utc_s=UTC_S + 10.15, boot_s=UP_S - 39.85)], True),
        ([UtcReport(received_s=10.15, utc_s=UTC_S - 39.85, boot_s=UP_S - 39.85)], False),  # late
        ([UtcReport(received_s=10.15, utc_s=UTC_S + 60.0, boot_s=UP_S + 10.15)], False),
        ([beat(10.5, armed=True)], False),
        ([beat(9.5, armed=False), beat(10.5, armed=True)], False),
        ([beat(10.5, armed=False)], True),
    ],
)
def test_a_clock_that_goes_back_needs_evidence(evidence: list[Input], is_believed: bool) -> None:
    told = UtcReport(received_s=5.0, utc_s=UTC_S + 5.0, boot_s=UP_S + 5.0)
    _, places = sort([*stream(0.0, 10.0), told, *BACK, *evidence])
    assert (Arrival.ANEW in places) == is_believed
    if not is_believed:
        assert set(places[100:]) == {Arrival.AGAIN}


def test_while_it_is_not_known_the_last_good_position_ages() -> None:
    track = Track()
    for item in [*stream(0.0, 10.0), *BACK]:
        track = observe(track, item, SETUP)
    state = estimate(track, 16.0)
    assert state is not None
    assert state.position_received_s == pytest.approx(9.9)


def test_a_clock_far_ahead_is_no_copy_and_one_message_of_it_no_clock() -> None:
    odd = position(9.95, boot_s=UP_S + 5000.0)
    _, places = sort([*stream(0.0, 20.0), odd])
    assert places.count(Arrival.AGAIN) == 1
    assert Arrival.ANEW not in places
    _, places = sort([*stream(0.0, 10.0), *restarted(10.0, 12.0, boot_s=UP_S + 5000.0)])
    assert places[102] is Arrival.ANEW


# A copy, or the message itself, comes so much later; most of the time there is none of it.
DELAYS = st.lists(
    st.tuples(
        st.lists(st.floats(0.0, 10.0), max_size=3),
        st.one_of(st.just(0.0), st.just(0.0), st.floats(0.0, 0.4)),
    ),
    min_size=120,
    max_size=120,
)


@given(delays=DELAYS)
@settings(max_examples=15, deadline=None)
def test_copies_at_random_change_no_decision(delays: list[tuple[list[float], float]]) -> None:
    clean = stream(0.0, 12.0)
    copies = [
        replace(item, received_s=item.received_s + late_s)
        for item, (lates_s, _) in zip(clean, delays, strict=True)
        for late_s in lates_s
    ]
    plain, mixed = Track(), Track()
    for item in clean:
        plain = observe(plain, item, SETUP)
    for heard in (item for item in arrived([*clean, *copies]) if item.received_s < 12.0):
        mixed = observe(mixed, heard, SETUP)
    assert mixed._replace(order=plain.order) == plain


@given(delays=DELAYS)
@settings(max_examples=15, deadline=None)
def test_whatever_comes_late_the_place_is_right_or_nothing_opens(
    delays: list[tuple[list[float], float]],
) -> None:
    clean = stream(0.0, 12.0)
    items = [
        replace(item, received_s=item.received_s + late_s)
        for item, (lates_s, itself_s) in zip(clean, delays, strict=True)
        for late_s in (*lates_s, itself_s)
    ]
    track = Track(consent=Consent(enabled=True))
    for item in arrived(items):
        now_s = item.received_s
        track = observe(track, item, SETUP)
        state = estimate(track, now_s)
        assert state is not None
        may_open = (
            state.position_valid and state.clock_agrees and now_s - state.position_received_s <= 0.8
        )
        if may_open:
            # What is not known here is the delay of the way: nobody answers TIMESYNC.
            assert state.east_m == pytest.approx(5.0 * now_s, abs=0.35)


def set_back(back_s: float, lates_s: Sequence[float], *, gap_s: float, by_utc: bool) -> list[Input]:
    """Return a flight whose clock is set back at 12 s, copied all the time, and told of as well."""

    def clock_s(now_s: float) -> float:
        return UP_S + now_s - (back_s if now_s > 12.0 else 0.0)

    told: list[Input] = [exchange(0.05 + i, clock_s(0.05 + i)) for i in range(30)]
    if by_utc:
        told = [
            UtcReport(received_s=it.received_s, utc_s=UTC_S + it.received_s, boot_s=UP_S)
            for it in told
        ]
        told = [
            replace(it, boot_s=clock_s(it.received_s)) for it in told if isinstance(it, UtcReport)
        ]
    begin_s = 12.0 + gap_s
    clean = [*stream(0.0, 12.0), *restarted(begin_s, 30.0, boot_s=clock_s(begin_s + 1e-9))]
    late = [
        replace(it, received_s=it.received_s + late_s + 0.01 * (i % 3))
        for i, it in enumerate(clean)
        for late_s in lates_s
    ]
    return [item for item in arrived([*clean, *late, *told]) if item.received_s < 30.0]


def far_off_m(items: Iterable[Input]) -> tuple[float, float]:
    """Return how far the place is off at worst where a valve may open, and when one last may."""
    track, worst_m, may_s = Track(consent=Consent(enabled=True)), 0.0, 0.0
    for item in items:
        now_s = item.received_s
        track = observe(track, item, SETUP)
        state = estimate(track, now_s)
        assert state is not None
        is_young = now_s - state.position_received_s <= 0.8
        if state.position_valid and state.clock_agrees and is_young:
            worst_m, may_s = max(worst_m, abs(state.east_m - 5.0 * now_s)), now_s
    return worst_m, may_s


@pytest.mark.parametrize("by_utc", [False, True])
@pytest.mark.parametrize("gap_s", [0.3, 3.0])
@pytest.mark.parametrize("lates_s", [(5.0,), (4.95, 5.0), (3.97, 5.07)])
def test_a_clock_set_back_among_copies_as_late_as_that(
    lates_s: tuple[float, ...], gap_s: float, by_utc: bool
) -> None:
    """A copy of before and a position by the new clock have the same time: only waiting helps."""
    worst_m, may_s = far_off_m(set_back(5.0, lates_s, gap_s=gap_s, by_utc=by_utc))
    assert worst_m < 0.5
    assert by_utc or may_s > 29.0


@given(
    back_s=st.floats(1.2, 9.0),
    aparts_s=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=3),
    gap_s=st.floats(0.1, 4.0),
    by_utc=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_a_clock_set_back_among_copies(
    back_s: float, aparts_s: list[float], gap_s: float, by_utc: bool
) -> None:
    lates_s = [max(back_s + each, 0.05) for each in aparts_s]
    assert far_off_m(set_back(back_s, lates_s, gap_s=gap_s, by_utc=by_utc))[0] < 0.5


def test_only_copies_of_late_make_a_clock_that_was_set_wait() -> None:
    order, _ = sort([*stream(0.0, 10.0), *stream(0.0, 10.0, late_s=11.0)])
    assert order.lateness.wait_s == 0.0  # nobody knows: the stream had ended before
    order, _ = sort(arrived([*stream(0.0, 30.0), *stream(0.0, 10.0, late_s=9.0)]))
    assert order.lateness.wait_s == pytest.approx(9.5, abs=0.05)
    order, _ = sort(stream(30.0, 120.0), order)
    assert order.lateness.wait_s == pytest.approx(9.5, abs=0.05)
    order, _ = sort(stream(120.0, 200.0), order)
    assert order.lateness.wait_s == 0.0

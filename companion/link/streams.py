"""Which messages to ask for, and when to ask again; pure, time is an argument.

ArduCopter streams nothing unasked, and a ground station on the same link overwrites our rates; so
what arrives is measured and what is too slow is asked for again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

_SAMPLE_S = 0.5
_WINDOW_S = 3.0
_ENOUGH = 0.7
_ASK_AGAIN_S = 5.0
_FAILURES_MAX = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """A message that we want. `group` is its MAV_DATA_STREAM for the older way to ask.

    An optional one (some vehicles never send it) is asked for once and not watched.
    """

    message_id: int
    rate_hz: float
    group: int
    optional: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRequest:
    """One request that is due; `by_group` where the newer way failed twice."""

    stream: Stream
    by_group: bool


_EXTENDED_STATUS, _RC_CHANNELS, _POSITION, _EXTRA2, _EXTRA3 = 2, 3, 6, 11, 12


def wanted_streams(*, position_rate_hz: float, is_px4: bool) -> tuple[Stream, ...]:
    """Return what the core and the statistics live on; few distinct rates, as ArduPilot likes."""
    estimator, wind = (230, 231) if is_px4 else (193, 168)
    return (
        Stream(message_id=33, rate_hz=position_rate_hz, group=_POSITION),
        Stream(message_id=74, rate_hz=10.0, group=_EXTRA2),
        Stream(message_id=24, rate_hz=5.0, group=_EXTENDED_STATUS),
        Stream(message_id=estimator, rate_hz=2.0, group=_EXTRA3),
        Stream(message_id=245, rate_hz=2.0, group=_EXTENDED_STATUS),
        Stream(message_id=65, rate_hz=5.0, group=_RC_CHANNELS),
        Stream(message_id=36, rate_hz=10.0, group=_RC_CHANNELS),
        Stream(message_id=wind, rate_hz=2.0, group=_EXTRA3, optional=True),
    )


@dataclass(slots=True)
class _Watch:
    """What is known of one stream: when it was asked for, and how often in vain."""

    stream: Stream
    asked_s: float
    failures: int = 0


@dataclass(slots=True)
class StreamSupervisor:
    """Says which streams to ask for, from the counts of what arrived."""

    may_group: bool
    _watches: list[_Watch] = field(default_factory=list)
    _samples: deque[tuple[float, dict[int, int]]] = field(
        default_factory=lambda: deque(maxlen=round(_WINDOW_S / _SAMPLE_S) + 2)
    )

    def start(self, streams: Iterable[Stream], now_s: float) -> tuple[StreamRequest, ...]:
        """Return a request for every stream: at the start, and after a reboot of the autopilot."""
        self._samples.clear()
        self._watches = [_Watch(stream=stream, asked_s=now_s) for stream in streams]
        return tuple(StreamRequest(stream=watch.stream, by_group=False) for watch in self._watches)

    def due(self, counts: Mapping[int, int], now_s: float) -> tuple[StreamRequest, ...]:
        """Return the requests that are due; `counts` are of all messages since the beginning."""
        if self._samples and now_s - self._samples[-1][0] < _SAMPLE_S:
            return ()
        self._samples.append((now_s, dict(counts)))
        while len(self._samples) > 1 and now_s - self._samples[1][0] >= _WINDOW_S:
            self._samples.popleft()
        began_s, before = self._samples[0]
        duration_s = now_s - began_s
        if duration_s < _WINDOW_S:
            return ()
        return tuple(
            self._ask_again(watch, now_s)
            for watch in self._watches
            if self._is_slow(watch, counts, before, duration_s)
            and now_s - watch.asked_s >= _ASK_AGAIN_S
        )

    def rate_hz(self, message_id: int) -> float | None:
        """Return the rate measured over the last seconds; None where it is too early to say."""
        if len(self._samples) < 2:
            return None
        (began_s, before), (ended_s, after) = self._samples[0], self._samples[-1]
        return (after.get(message_id, 0) - before.get(message_id, 0)) / (ended_s - began_s)

    @staticmethod
    def _is_slow(
        watch: _Watch, counts: Mapping[int, int], before: Mapping[int, int], duration_s: float
    ) -> bool:
        message_id = watch.stream.message_id
        rate_hz = (counts.get(message_id, 0) - before.get(message_id, 0)) / duration_s
        if rate_hz >= _ENOUGH * watch.stream.rate_hz:
            watch.failures = 0
            return False
        return not watch.stream.optional

    def _ask_again(self, watch: _Watch, now_s: float) -> StreamRequest:
        watch.asked_s = now_s
        watch.failures += 1
        by_group = self.may_group and watch.failures > _FAILURES_MAX
        return StreamRequest(stream=watch.stream, by_group=by_group)

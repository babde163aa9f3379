"""Which messages to ask for, and when to ask again; pure, time is an argument.

ArduCopter streams nothing unasked, and a ground station on the same link overwrites our rates; so
what arrives is measured and what is too slow is asked for again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.codec import AUTOPILOT_COMPONENT, Codec

_SAMPLE_S = 0.5
_WINDOW_S = 3.0
# So much of a wanted rate counts as all of it.
ENOUGH = 0.7
_ASK_AGAIN_S = 5.0
# So long a stream is slow before it is asked for: then the window holds nothing of before.
_SLOW_S = 2.0
_FAILURES_MAX = 2
# ArduPilot sends everything at a quarter of its rate while parameters, missions or files go over
# the same link (GCS_Common.cpp). Asking again changes nothing, so this is waited for; for no
# longer than a slow transfer takes.
_QUARTER = (0.15, 0.35)
_QUARTER_WAIT_S = 30.0
# A stream that was right and is slow again, this often, is changed by another station.
_FOUGHT_COUNT = 3
# An answer to a request later than this belongs to another one.
_ANSWER_MAX_S = 2.0
_REFUSED = frozenset({2, 3, 4})  # MAV_RESULT denied, unsupported, failed


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


_RAW_SENSORS, _EXTENDED_STATUS, _RC_CHANNELS, _POSITION = 1, 2, 3, 6
_EXTRA1, _EXTRA2, _EXTRA3 = 10, 11, 12
# Ten times a second is the least that bridges two positions (core/options/inertial.py).
IMU_RATE_MIN_HZ, IMU_RATE_MAX_HZ = 10.0, 20.0


def wanted_streams(
    *,
    position_rate_hz: float,
    is_px4: bool,
    with_mission: bool = False,
    with_battery: bool = False,
    with_switch: bool = True,
    with_imu: bool = False,
) -> tuple[Stream, ...]:
    """Return what the core and the statistics live on; few distinct rates, as ArduPilot likes.

    `with_battery`: also the battery monitors, of which a flow meter may be one.
    `with_switch`: the pilot's channels have to come; PX4 sends none without a receiver.
    `with_mission`: also which item is flown to; PX4 has no such stream and says it by itself.
    `with_imu`: attitude and accelerometer too, as often as positions.
    """
    estimator, wind = (230, 231) if is_px4 else (193, 168)
    with_mission = with_mission and not is_px4
    return (
        Stream(message_id=33, rate_hz=position_rate_hz, group=_POSITION),
        Stream(message_id=74, rate_hz=10.0, group=_EXTRA2),
        Stream(message_id=24, rate_hz=5.0, group=_EXTENDED_STATUS),
        Stream(message_id=estimator, rate_hz=2.0, group=_EXTRA3),
        Stream(message_id=245, rate_hz=2.0, group=_EXTENDED_STATUS),
        Stream(message_id=65, rate_hz=5.0, group=_RC_CHANNELS, optional=not with_switch),
        Stream(message_id=36, rate_hz=10.0, group=_RC_CHANNELS),
        Stream(message_id=wind, rate_hz=2.0, group=_EXTRA3, optional=True),
        Stream(message_id=132, rate_hz=10.0, group=_EXTRA3, optional=True),  # height above the crop
        # ArduPilot's battery monitors take turns: three of them come 3 times a second each.
        Stream(message_id=2, rate_hz=1.0, group=_EXTRA3, optional=True),  # time of day
        *([Stream(message_id=147, rate_hz=10.0, group=_EXTRA3)] if with_battery else []),
        *(_imu_streams(position_rate_hz, is_px4=is_px4) if with_imu else ()),
        *([Stream(message_id=42, rate_hz=2.0, group=_EXTENDED_STATUS)] if with_mission else []),
    )


def _imu_streams(rate_hz: float, *, is_px4: bool) -> tuple[Stream, Stream]:
    """Return attitude and accelerometer; faster than 20 Hz they say nothing more."""
    rate_hz = min(max(rate_hz, IMU_RATE_MIN_HZ), IMU_RATE_MAX_HZ)
    imu = 105 if is_px4 else 26  # HIGHRES_IMU, SCALED_IMU
    return (
        Stream(message_id=30, rate_hz=rate_hz, group=_EXTRA1, optional=True),
        Stream(message_id=imu, rate_hz=rate_hz, group=_RAW_SENSORS, optional=True),
    )


def _name(message_id: int) -> str:
    """Return what a message is called.

    >>> _name(65)
    'RC_CHANNELS'
    """
    return str(mavlink.mavlink_map[message_id].msgname)


@dataclass(slots=True)
class _Watch:
    """What is known of one stream: when it was asked for, and how often in vain."""

    stream: Stream
    asked_s: float
    failures: int = 0
    slow_since_s: float | None = None
    is_refused: bool = False
    was_right: bool = False
    changed_count: int = 0

    def measured(self, share: float, now_s: float) -> None:
        """Take how much of the wanted rate has come over the last seconds."""
        if share >= ENOUGH:
            self.failures, self.slow_since_s = 0, None
            self.was_right, self.is_refused = True, False
        elif self.slow_since_s is None and not self.stream.optional:
            self.slow_since_s = now_s


@dataclass(slots=True)
class StreamSupervisor:
    """Says which streams to ask for, from the counts of what arrived."""

    may_group: bool
    _asked: deque[int] = field(default_factory=lambda: deque(maxlen=64))
    _quarter_since_s: float | None = None
    _told: set[str] = field(default_factory=set)
    _watches: list[_Watch] = field(default_factory=list)
    _samples: deque[tuple[float, dict[int, int]]] = field(
        default_factory=lambda: deque(maxlen=round(_WINDOW_S / _SAMPLE_S) + 2)
    )

    def start(self, streams: Iterable[Stream], now_s: float) -> tuple[StreamRequest, ...]:
        """Return a request for every stream: at the start, and after a reboot of the autopilot."""
        self._samples.clear()
        self._quarter_since_s = None
        self._watches = [_Watch(stream=stream, asked_s=now_s) for stream in streams]
        self._asked.clear()
        self._asked.extend(watch.stream.message_id for watch in self._watches)
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
        shares = [
            (counts.get(watch.stream.message_id, 0) - before.get(watch.stream.message_id, 0))
            / (duration_s * watch.stream.rate_hz)
            for watch in self._watches
        ]
        for watch, share in zip(self._watches, shares, strict=True):
            watch.measured(share, now_s)
        if self._is_quartered(shares, now_s):
            return ()
        return tuple(
            self._ask_again(watch, now_s)
            for watch in self._watches
            if watch.slow_since_s is not None
            and now_s - watch.slow_since_s >= _SLOW_S
            and now_s - watch.asked_s >= _ASK_AGAIN_S
        )

    def answered(self, result: int, now_s: float) -> None:
        """Take the autopilot's answer to the oldest request that has none yet.

        An answer does not name its message. One that was lost shifts the rest; so a refusal only
        chooses how a stream that is measured to be slow is asked for.
        """
        if not self._asked:
            return
        message_id = self._asked.popleft()
        for watch in self._watches:
            if watch.stream.message_id == message_id:
                young = 0.0 <= now_s - watch.asked_s <= _ANSWER_MAX_S
                watch.is_refused = young and result in _REFUSED

    def trouble(self) -> str | None:
        """Return once what the operator should know of the rates, in a line of his screen."""
        missing = [
            watch
            for watch in self._watches
            if watch.failures > _FAILURES_MAX and not watch.was_right and not watch.changed_count
        ]
        said = {}
        if any(watch.changed_count >= _FOUGHT_COUNT for watch in self._watches):
            said["fought"] = "another station changes our stream rates"
        if missing:
            verb = "refused" if any(watch.is_refused for watch in missing) else "not sent as asked"
            names = " ".join(_name(watch.stream.message_id) for watch in missing[:3])
            more = " ..." if len(missing) > 3 else ""
            said["missing"] = f"{verb}: {names}{more}"
        for key, text in said.items():
            if key not in self._told:
                self._told.add(key)
                return text
        return None

    def _is_quartered(self, shares: list[float], now_s: float) -> bool:
        """Whether everything comes at a quarter of its rate, and not for too long yet."""
        low, high = _QUARTER
        fast = [
            share
            for watch, share in zip(self._watches, shares, strict=True)
            # Of a slow stream there are one or two in the window: that says nothing.
            if not watch.stream.optional and watch.stream.rate_hz >= 5.0
        ]
        if not fast or not all(low <= share <= high for share in fast):
            self._quarter_since_s = None
            return False
        if self._quarter_since_s is None:
            self._quarter_since_s = now_s
        return now_s - self._quarter_since_s <= _QUARTER_WAIT_S

    def rate_hz(self, message_id: int) -> float | None:
        """Return the rate measured over the last seconds; None where it is too early to say."""
        if len(self._samples) < 2:
            return None
        (began_s, before), (ended_s, after) = self._samples[0], self._samples[-1]
        return (after.get(message_id, 0) - before.get(message_id, 0)) / (ended_s - began_s)

    def _ask_again(self, watch: _Watch, now_s: float) -> StreamRequest:
        watch.asked_s = now_s
        watch.failures += 1
        if watch.was_right:
            watch.was_right = False
            watch.changed_count += 1
        by_group = self.may_group and (watch.is_refused or watch.failures > _FAILURES_MAX)
        if not by_group:
            self._asked.append(watch.stream.message_id)
        return StreamRequest(stream=watch.stream, by_group=by_group)


# How the link does: counts since the start, rates since the last line.


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """Counts since the link was opened, and the mean rates since the statistics before."""

    bytes_in: int
    bytes_out: int
    frames_in: int
    frames_out: int
    bad_frames: int
    refused_frames: int
    unsent_frames: int
    lost_percent: float | None
    frames_per_s: float | None
    bytes_in_per_s: float | None
    bytes_out_per_s: float | None
    position_hz: float | None
    round_trip_s: float | None
    copied_positions: int = 0
    excess_bytes: int = 0
    excess_frames: int = 0

    def line(self) -> str:
        """Return it in one line, for the record of a flight and the log."""
        parts = [
            f"in {self.frames_in} frames{_rate(self.frames_per_s, '/s')}",
            f"{self.bytes_in} B{_rate(self.bytes_in_per_s, ' B/s')}",
            f"out {self.frames_out} frames",
            f"{self.bytes_out} B{_rate(self.bytes_out_per_s, ' B/s')}",
            f"bad {self.bad_frames}",
            f"refused {self.refused_frames}",
            f"unsent {self.unsent_frames}",
        ]
        if self.copied_positions:
            parts.append(f"positions twice or too late {self.copied_positions}")
        if self.excess_bytes or self.excess_frames:
            parts.append(f"not read {self.excess_bytes} B, {self.excess_frames} frames")
        if self.lost_percent is not None:
            parts.append(f"lost {self.lost_percent:.2f} % of the autopilot's")
        if self.position_hz is not None:
            parts.append(f"positions {self.position_hz:.1f} Hz")
        if self.round_trip_s is not None:
            parts.append(f"round trip {1000.0 * self.round_trip_s:.1f} ms")
        return ", ".join(parts)


def _rate(rate: float | None, unit: str) -> str:
    return "" if rate is None else f" ({rate:.1f}{unit})"


# So many positions that came twice or too late, in so long, are told; once in a minute.
COPIES_MANY = 20
COPIES_IN_S = 10.0
COPIES_AGAIN_S = 60.0


class Meter:
    """Counts what goes out, and compares counts with those of the last time it was read."""

    def __init__(self) -> None:
        self.bytes_out = 0
        self.frames_out = 0
        self.unsent_frames = 0
        self.copied_positions = 0
        self._copied_s: deque[float] = deque(maxlen=COPIES_MANY)
        self._copies_told_s = float("-inf")
        self._before: dict[str, tuple[float, int, int, int]] = {}

    def sent(self, size: int, *, has_left: bool) -> None:
        """Count one frame that went out, or could not."""
        if has_left:
            self.frames_out += 1
            self.bytes_out += size
        else:
            self.unsent_frames += 1

    def copied(self, now_s: float) -> bool:
        """Count a position that came twice or too late; return whether many are to be told of."""
        self.copied_positions += 1
        self._copied_s.append(now_s)
        if len(self._copied_s) < COPIES_MANY or now_s - self._copied_s[0] > COPIES_IN_S:
            return False
        if now_s - self._copies_told_s < COPIES_AGAIN_S:
            return False
        self._copies_told_s = now_s
        return True

    def read(
        self,
        codec: Codec,
        now_s: float,
        *,
        series: str = "line",
        position_hz: float | None = None,
        round_trip_s: float | None = None,
    ) -> LinkStatistics:
        """Return the statistics up to now; rates are those since the last of this series."""
        seen = codec.counts
        counts = (now_s, seen.frames, seen.bytes_in, self.bytes_out)
        before = self._before.get(series)
        self._before[series] = counts
        rates: list[float | None] = [None] * 3
        if before is not None and now_s > before[0]:
            span_s = now_s - before[0]
            rates = [(counts[k] - before[k]) / span_s for k in (1, 2, 3)]
        vehicle = codec.vehicle
        lost_percent = None
        if vehicle is not None:
            autopilot = (vehicle.system_id, AUTOPILOT_COMPONENT)
            came, lost = codec.lost_frames.get(autopilot, (0, 0))
            lost_percent = 100.0 * lost / (came + lost) if came else None
        return LinkStatistics(
            bytes_in=seen.bytes_in,
            bytes_out=self.bytes_out,
            frames_in=seen.frames,
            frames_out=self.frames_out,
            bad_frames=seen.bad_frames,
            refused_frames=seen.refused_frames,
            unsent_frames=self.unsent_frames,
            lost_percent=lost_percent,
            frames_per_s=rates[0],
            bytes_in_per_s=rates[1],
            bytes_out_per_s=rates[2],
            position_hz=position_hz,
            round_trip_s=round_trip_s,
            copied_positions=self.copied_positions,
            excess_bytes=seen.excess_bytes,
            excess_frames=seen.excess_frames,
        )

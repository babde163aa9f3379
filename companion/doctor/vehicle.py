"""Is the vehicle ready: link, streams, position, judged from what was heard of it.

Listens to the vehicle for some seconds, by the link of a run, and orders nothing but closed.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TypeVar

from companion.config import Config
from companion.config.limits import LimitsFile
from companion.config.model import FIXES
from companion.core.label import is_from, wind_from_deg
from companion.core.setup import Setup
from companion.core.types import (
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    RcReport,
    Telemetry,
    WindReport,
)
from companion.doctor.check import Check, fail, not_applicable, ok, split_advice, warn
from companion.errors import LinkError
from companion.link.streams import ENOUGH
from companion.link.vehicle_link import VehicleLink
from companion.output.autopilot_guard import more_parameters, wanted_parameters
from companion.output.autopilot_options import ServoOptions, ardupilot_places
from companion.receiver import ReceiverOffset, ReceiverWatch

# Farther from the map than a take-off place is: another field, or a datum that is wrong.
MAP_MAX_M = 2_000.0
_VEHICLE = (
    "heartbeat", "disarmed", "streams", "vehicle-clock", "fix", "estimator", "place", "rc-switch",
    "wind",
)  # fmt: skip


def link_checks(heard: Heard, config: Config, setup: Setup | None) -> Iterator[Check]:
    """Yield the checks of link and vehicle, but for its outputs."""
    if heard.refused is not None:
        yield fail("link", *split_advice(heard.refused, "correct link.url"))
        yield from (not_applicable(name, "the link did not open") for name in _VEHICLE)
        return
    if heard.system_id is None:
        yield _unheard(heard)
        yield from (not_applicable(name, "no vehicle heard") for name in _VEHICLE)
        return
    if heard.troubles:
        yield warn("link", *split_advice(heard.troubles[-1], "see docs/howto/links.md"))
    else:
        yield ok("link", heard.url)
    yield _heartbeat(heard)
    yield _disarmed(heard)
    yield _streams(heard)
    yield _clock(heard)
    yield _fix(heard, FIXES[config.safety.fix])
    yield _estimator(heard)
    yield _place(heard, setup)
    yield _rc_switch(heard, config)
    yield wind_check(heard, config)


def no_link(why: str) -> Iterator[Check]:
    """Yield the same checks where the link was not to be opened."""
    yield from (not_applicable(name, why) for name in ("link", *_VEHICLE))


def _unheard(heard: Heard) -> Check:
    if heard.troubles:
        return fail("link", *split_advice(heard.troubles[-1], "see docs/howto/links.md"))
    return fail(
        "link",
        f"{heard.url}: no heartbeat from an autopilot within {heard.waited_s:.0f} s",
        "check that the flight controller is on, and that link.url leads to it",
    )


def _heartbeat(heard: Heard) -> Check:
    text = f"system {heard.system_id}, {heard.autopilot}, mode {heard.mode}"
    if heard.autopilot.lower() not in ("ardupilot", "px4"):
        return fail("heartbeat", text, "use ArduPilot or PX4, or set link.system_id")
    return ok("heartbeat", text)


def _disarmed(heard: Heard) -> Check:
    if heard.is_armed is None:
        return warn(
            "disarmed", "not known: no heartbeat", "check that heartbeats arrive once a second"
        )
    if heard.is_armed:
        fix = "disarm and try again: outputs are tested on a disarmed vehicle only"
        return warn("disarmed", "the vehicle is armed", fix)
    return ok("disarmed", "the vehicle is disarmed")


def _streams(heard: Heard) -> Check:
    if not heard.rates:
        fix = "try again with a longer --wait-s"
        return warn("streams", "not observed for long enough", fix)
    slow = [rate for rate in heard.rates if not rate.is_enough]
    if not slow:
        rates = ", ".join(f"{rate.name} {rate.rate_hz:.0f} Hz" for rate in heard.rates[:3])
        return ok("streams", f"{rates}, all as requested")
    texts = [f"{one.name} {one.rate_hz:.1f} Hz instead of {one.wanted_hz:g} Hz" for one in slow]
    fix = (
        "check whether another station sets stream rates, or the link is too slow "
        "(docs/howto/links.md)"
    )
    # Without a position there is no spraying at all; the rest closes, or costs accuracy.
    is_blind = any(one.name == "position" and not one.rate_hz >= 2.0 for one in slow)
    return (fail if is_blind else warn)("streams", ", ".join(texts), fix)


def _clock(heard: Heard) -> Check:
    if not heard.is_clock_known:
        fix = "let the link pass TIMESYNC both ways; until then positions count as fresh"
        return warn("vehicle-clock", "no answer to TIMESYNC", fix)
    return ok("vehicle-clock", "the autopilot answers TIMESYNC")


def _fix(heard: Heard, least: Fix) -> Check:
    if heard.fix is None:
        return fail("fix", "the GNSS receiver does not report", "check its cable and GPS_TYPE")
    accuracy = "" if heard.accuracy_m is None else f", {heard.accuracy_m:.2f} m"
    text = f"{heard.fix.name.lower().replace('_', '-')}{accuracy}"
    if not heard.fix >= least:
        wanted = least.name.lower().replace("_", "-")
        fix = "wait for it outdoors, and check that corrections arrive"
        return fail("fix", f"{text}, but at least {wanted} is needed", fix)
    return ok("fix", text)


def _estimator(heard: Heard) -> Check:
    if heard.is_estimator_healthy is None:
        return warn(
            "estimator",
            "the autopilot does not report it",
            "check its stream (docs/howto/links.md)",
        )
    if not heard.is_estimator_healthy:
        fix = "wait for it to settle, or calibrate compass and accelerometers"
        return fail("estimator", "the autopilot does not trust its own position", fix)
    if heard.receiver is None:
        return ok("estimator", "healthy")
    if heard.receiver.is_unusual:
        fix = (
            "wait, or correct the antenna's place (GPS_POS1_X, EKF2_GPS_POS_X) and the receiver's "
            "delay (GPS1_DELAY_MS, EKF2_GPS_DELAY)"
        )
        return warn("estimator", heard.receiver.words, fix)
    return ok("estimator", f"healthy; {heard.receiver.words}")


def _place(heard: Heard, setup: Setup | None) -> Check:
    if setup is None:
        return not_applicable("place", "no map to compare it with")
    if heard.position is None:
        return fail("place", "no position", "wait for a fix, and check that positions are streamed")
    place = heard.position
    east_m, north_m = setup.frame.to_local(place.latitude_deg, place.longitude_deg)
    west_m, south_m, to_east_m, to_north_m = setup.prescription.bounds_m
    away_m = math.hypot(
        max(west_m - east_m, 0.0, east_m - to_east_m),
        max(south_m - north_m, 0.0, north_m - to_north_m),
    )
    if not away_m <= MAP_MAX_M:
        fix = "load the map of this field, or correct prescription.offset_east_m and _north_m"
        return warn("place", f"the vehicle is {away_m / 1e3:.1f} km from the map", fix)
    return ok("place", f"{away_m:.0f} m from the map")


def _rc_switch(heard: Heard, config: Config) -> Check:
    name, channel = "rc-switch", config.safety.rc_channel
    if channel is None:
        return not_applicable(name, "safety.rc_channel is not set")
    pulses = heard.rc_pulse_us
    pulse_us = pulses[channel - 1] if channel <= len(pulses) else 0
    if not 800 <= pulse_us <= 2200:
        fix = "turn the transmitter on, and check that it sends this channel"
        return fail(name, f"no signal on RC channel {channel}", fix)
    return ok(name, f"RC channel {channel} reads {pulse_us} us")


def wind_check(heard: Heard, config: Config) -> Check:
    """Return whether the wind is known where it must be, and one that the label allows."""
    label = config.label
    limits = () if label is None else (label.span("wind_m_s"), label.wind_from_deg)
    must = any(limits) and label is not None and label.wind_by == "autopilot"
    if heard.has_wind and label is not None and any(limits):
        return _wind_by_label(heard, label, must=must)
    if not (config.safety.wind_required or must):
        return not_applicable("wind", "safety.wind_required is false")
    if not heard.has_wind:
        fix = (
            'write wind_by = "operator" in the limits file and measure it'
            if must
            else "write safety.wind_required = false and measure it"
        )
        return fail(
            "wind",
            "no wind is known, without which nothing is sprayed",
            f"have the autopilot estimate it (exactly 0 is no estimate), or {fix}",
        )
    return ok("wind", "reported by the autopilot")


def _wind_by_label(heard: Heard, label: LimitsFile, *, must: bool) -> Check:
    """Return whether the wind that was heard is one that label and permit allow."""
    span, from_deg = label.span("wind_m_s"), heard.wind_from_deg
    speed_m_s = math.nan if heard.wind_m_s is None else heard.wind_m_s
    if span is not None and not span[0] <= speed_m_s <= span[1]:
        text = f"{speed_m_s:.1f} m/s, and {label.title} allows {label.words('wind_m_s', 'm/s')}"
        return fail("wind", text, "wait for such a wind")
    asked = label.wind_from_deg and (must or from_deg is not None)
    if asked and not is_from(from_deg, label.wind_from_deg):
        text = "no direction is reported" if from_deg is None else f"from {from_deg:.0f} deg"
        return fail("wind", f"{text}, and {label.title} allows it {label.wind_words()}", "wait")
    return ok("wind", f"{speed_m_s:.1f} m/s: allowed by {label.title}")


# What was heard of the vehicle in some seconds of listening; judged in `vehicle.py`.


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A stream: its rate as wanted and as it came."""

    name: str
    wanted_hz: float
    rate_hz: float

    @property
    def is_enough(self) -> bool:
        """Return whether it comes as wanted; NaN does not."""
        return self.rate_hz >= ENOUGH * self.wanted_hz


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """Where the vehicle says it is."""

    latitude_deg: float
    longitude_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """All that `vehicle.py` judges. What was not heard is None, or empty.

    `refused` is why the link cannot be opened; `troubles` what the link itself said of it.
    """

    url: str
    waited_s: float = 0.0
    refused: str | None = None
    troubles: tuple[str, ...] = ()
    system_id: int | None = None
    autopilot: str = "unknown"
    is_px4: bool = False
    is_armed: bool | None = None
    mode: str | None = None
    rates: tuple[Rate, ...] = ()
    fix: Fix | None = None
    accuracy_m: float | None = None
    is_estimator_healthy: bool | None = None
    receiver: ReceiverOffset | None = None
    position: Position | None = None
    rc_pulse_us: tuple[int, ...] = ()
    has_wind: bool = False
    wind_m_s: float | None = None
    wind_from_deg: float | None = None
    is_clock_known: bool = False
    parameters: Mapping[str, float | None] | None = None
    # By channel: what the outputs read after closed was ordered; None where nothing is known.
    outputs_us: Mapping[int, int] = field(default_factory=dict)
    is_closed_ordered: bool = False
    order_results: tuple[int, ...] = ()


# The first heartbeat is at most a second away, the streams come half a second after that.
_SETTLE_S = 1.0
_MEASURE_S = 3.0
_STEP_S = 0.05
_CLOSE_EVERY_S = 1.0
# Besides SPRW_ENABLE, which `wanted_parameters` has.
WATCHDOG_PARAMETERS = (
    "SPRW_FIRST",
    "SPRW_LAST",
    "SPRW_MASK",
    "SPRW_CLOSED_US",
    "SPRW_RET_CH",
)
_NAMES = {33: "position", 74: "speed", 24: "GNSS", 193: "estimator", 230: "estimator"} | {
    245: "landed state",
    65: "RC channels",
    36: "servo outputs",
}

T = TypeVar("T", bound=Input)


class VehicleListener:
    """Takes all that comes; also the one who is told of the autopilot's outputs."""

    def __init__(self, options: ServoOptions | None, now_s: Callable[[], float]) -> None:
        self._options = options
        self._now_s = now_s
        self._ports: dict[int, tuple[int, ...]] = {}
        self._known: dict[str, float | None] = {}
        self.is_px4 = False
        self.is_learned = options is None
        self.met_s: float | None = None
        self._last: dict[type[Input], Input] = {}
        self.results: list[int] = []
        self.receiver = ReceiverWatch()

    def met(self, is_px4: bool) -> Sequence[str]:
        """Take that the vehicle was met; return the parameters to read of it."""
        self.is_px4, self.met_s = is_px4, self._now_s()
        self._known.clear()
        if self._options is None:
            return ()
        self.is_learned = False
        more = () if is_px4 else WATCHDOG_PARAMETERS
        return (*wanted_parameters(self._options, is_px4=is_px4), *more)

    def armed(self, is_armed: bool) -> None:
        """Nothing: the heartbeat itself is kept."""

    def learned(self, known: dict[str, float | None]) -> Sequence[str]:
        """Take parameters; return those to read besides."""
        self._known.update(known)
        if self._options is None:
            return ()
        more = more_parameters(self._options, self._known, is_px4=self.is_px4)
        self.is_learned = not more
        return more

    def reported(self, port: int, pulse_us: Sequence[int], at_s: float) -> None:  # noqa: ARG002 - OutputListener
        """Take what the outputs read."""
        self._ports[port] = tuple(pulse_us)

    @property
    def parameters(self) -> dict[str, float | None] | None:
        """Return what was read; None where the reading did not come to its end."""
        return dict(self._known) if self.is_learned else None

    def outputs_us(self) -> dict[int, int]:
        """Return what the channels of an ArduPilot read."""
        if self._options is None or self.is_px4:
            return {}
        found = {}
        places = ardupilot_places(self._options.outputs)
        for channel, ((port, index),) in zip(self._options.outputs, places, strict=True):
            pulses = self._ports.get(port, ())
            if index < len(pulses):
                found[channel] = pulses[index]
        return found

    def take(self, inputs: Sequence[Input]) -> None:
        """Keep the last of each kind, and what a receiver differs by."""
        for item in inputs:
            self._last[type(item)] = item
            self.receiver.take(item)

    def latest(self, kind: type[T]) -> T | None:
        """Return the last of a kind."""
        return next((item for item in self._last.values() if isinstance(item, kind)), None)


def rest_pulses(options: ServoOptions) -> dict[int, int]:
    """Return the pulses of the safe state: valves closed, a return valve open, motors stopped.

    >>> rest_pulses(ServoOptions(channels=(9, 10), return_channel=15))
    {9: 1000, 10: 1000, 15: 2000}
    """
    pulses = dict.fromkeys(options.channels, options.closed_us)
    if options.return_channel is not None:
        pulses[options.return_channel] = options.full_us
    return pulses | {drive.channel: drive.stop_us for drive in options.drives}


async def listen(
    link: VehicleLink,
    url: str,
    *,
    options: ServoOptions | None,
    wait_s: float,
    clock: Callable[[], float] = time.monotonic,
) -> Heard:
    """Return what was heard until all is known, for `wait_s` at most.

    With `options` the outputs of a disarmed ArduPilot are ordered closed, to see whether they obey.
    """
    listener = VehicleListener(options, clock)
    troubles: list[str] = []
    link.follow_outputs(listener)
    link.on_order_ack(listener.results.append)
    link.on_event(lambda _at_s, kind, text: troubles.append(text) if kind == "link" else None)
    wake = asyncio.Event()
    began_s = clock()
    try:
        await link.open(wake.set)
    except LinkError as error:
        return Heard(url=url, refused=str(error))
    try:
        rates, is_ordered = await _attend(link, listener, wake, options, began_s + wait_s, clock)
    finally:
        await link.close()
    return _heard(link, listener, url, clock() - began_s, troubles, rates, is_ordered)


async def _attend(
    link: VehicleLink,
    listener: VehicleListener,
    wake: asyncio.Event,
    options: ServoOptions | None,
    until_s: float,
    clock: Callable[[], float],
) -> tuple[tuple[Rate, ...], bool]:
    """Keep the link going; return the rates of the streams, and whether closed was ordered."""
    counts: dict[int, int] | None = None
    counted_s = now_s = clock()
    ordered_s = float("-inf")
    while now_s < until_s:
        wake.clear()
        listener.take(link.receive())
        link.tell(None, now_s)
        if _may_order(listener) and options is not None and now_s - ordered_s >= _CLOSE_EVERY_S:
            ordered_s = now_s
            for channel, pulse_us in rest_pulses(options).items():
                link.order(channel, pulse_us)
            link.flush_orders()
        met_s = listener.met_s
        if counts is None and met_s is not None and now_s - met_s >= _SETTLE_S:
            counts, counted_s = dict(link.component.codec.vehicle_counts), now_s
        if counts is not None and now_s - counted_s >= _MEASURE_S and listener.is_learned:
            break
        with suppress(TimeoutError):
            await asyncio.wait_for(wake.wait(), _STEP_S)
        now_s = clock()
    is_ordered = ordered_s > float("-inf")
    if counts is None or not now_s > counted_s:
        return (), is_ordered
    after = link.component.codec.vehicle_counts
    rates = tuple(
        Rate(
            name=_NAMES[stream.message_id],
            wanted_hz=stream.rate_hz,
            rate_hz=(after.get(stream.message_id, 0) - counts.get(stream.message_id, 0))
            / (now_s - counted_s),
        )
        for stream in link.component.streams
        if stream.message_id in _NAMES and not stream.optional
    )
    return rates, is_ordered


def _may_order(listener: VehicleListener) -> bool:
    """Return whether closed may be ordered: to a disarmed ArduPilot, whose outputs show it."""
    heartbeat = listener.latest(HeartbeatReport)
    return heartbeat is not None and not heartbeat.armed and not listener.is_px4


def _heard(
    link: VehicleLink,
    listener: VehicleListener,
    url: str,
    waited_s: float,
    troubles: list[str],
    rates: tuple[Rate, ...],
    is_ordered: bool,
) -> Heard:
    vehicle = link.component.codec.vehicle
    heartbeat, position = listener.latest(HeartbeatReport), listener.latest(Telemetry)
    gnss, estimator = listener.latest(GnssReport), listener.latest(EstimatorReport)
    rc, wind = listener.latest(RcReport), listener.latest(WindReport)
    # Not its greeting and not its counts.
    said = tuple(text for text in troubles if not text.startswith(("vehicle: ", "in ")))
    heard = Heard(
        url=url,
        waited_s=waited_s,
        troubles=said,
        rates=rates,
        fix=None if gnss is None else gnss.fix,
        accuracy_m=None if gnss is None else gnss.horizontal_accuracy_m,
        is_estimator_healthy=None if estimator is None else estimator.healthy,
        position=None
        if position is None
        else Position(latitude_deg=position.latitude_deg, longitude_deg=position.longitude_deg),
        rc_pulse_us=() if rc is None else rc.pulse_us,
        receiver=listener.receiver.offset,
        has_wind=wind is not None and wind.speed_m_s is not None,
        wind_m_s=None if wind is None else wind.speed_m_s,
        wind_from_deg=wind_from_deg(wind),
        is_clock_known=link.component.clock.is_known,
        outputs_us=listener.outputs_us(),
        is_closed_ordered=is_ordered,
        order_results=tuple(listener.results),
    )
    if vehicle is None or heartbeat is None:
        return heard
    return replace(
        heard,
        system_id=vehicle.system_id,
        autopilot=heartbeat.autopilot,
        is_px4=vehicle.is_px4,
        is_armed=heartbeat.armed,
        mode=heartbeat.mode,
        parameters=listener.parameters,
    )

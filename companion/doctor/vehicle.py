"""Is the vehicle ready: link, streams, position, judged from what was heard of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from companion.config import Config
from companion.config.limits import LimitsFile
from companion.config.model import FIXES
from companion.core.label import is_from
from companion.core.setup import Setup
from companion.core.types import Fix
from companion.doctor.check import Check, fail, not_applicable, ok, split_advice, warn
from companion.link.streams import ENOUGH

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
    return ok("estimator", "healthy")


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

"""Listens to the vehicle for some seconds, by the link of a run, and orders nothing but closed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

from companion.core.label import wind_from_deg
from companion.core.types import (
    EstimatorReport,
    GnssReport,
    HeartbeatReport,
    Input,
    RcReport,
    Telemetry,
    WindReport,
)
from companion.doctor.vehicle import Heard, Position, Rate
from companion.errors import LinkError
from companion.link.vehicle_link import VehicleLink
from companion.output.autopilot_findings import more_parameters, wanted_parameters
from companion.output.autopilot_options import ServoOptions, ardupilot_places

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


class Ear:
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
        """Keep the last of each kind."""
        for item in inputs:
            self._last[type(item)] = item

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
    ear = Ear(options, clock)
    troubles: list[str] = []
    link.follow_outputs(ear)
    link.on_order_ack(ear.results.append)
    link.on_event(lambda _at_s, kind, text: troubles.append(text) if kind == "link" else None)
    wake = asyncio.Event()
    began_s = clock()
    try:
        await link.open(wake.set)
    except LinkError as error:
        return Heard(url=url, refused=str(error))
    try:
        rates, is_ordered = await _attend(link, ear, wake, options, began_s + wait_s, clock)
    finally:
        await link.close()
    return _heard(link, ear, url, clock() - began_s, troubles, rates, is_ordered)


async def _attend(
    link: VehicleLink,
    ear: Ear,
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
        ear.take(link.receive())
        link.tell(None, now_s)
        if _may_order(ear) and options is not None and now_s - ordered_s >= _CLOSE_EVERY_S:
            ordered_s = now_s
            for channel, pulse_us in rest_pulses(options).items():
                link.order(channel, pulse_us)
            link.flush_orders()
        met_s = ear.met_s
        if counts is None and met_s is not None and now_s - met_s >= _SETTLE_S:
            counts, counted_s = dict(link.component.codec.vehicle_counts), now_s
        if counts is not None and now_s - counted_s >= _MEASURE_S and ear.is_learned:
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


def _may_order(ear: Ear) -> bool:
    """Return whether closed may be ordered: to a disarmed ArduPilot, whose outputs show it."""
    heartbeat = ear.latest(HeartbeatReport)
    return heartbeat is not None and not heartbeat.armed and not ear.is_px4


def _heard(
    link: VehicleLink,
    ear: Ear,
    url: str,
    waited_s: float,
    troubles: list[str],
    rates: tuple[Rate, ...],
    is_ordered: bool,
) -> Heard:
    vehicle = link.component.codec.vehicle
    heartbeat, position = ear.latest(HeartbeatReport), ear.latest(Telemetry)
    gnss, estimator = ear.latest(GnssReport), ear.latest(EstimatorReport)
    rc, wind = ear.latest(RcReport), ear.latest(WindReport)
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
        has_wind=wind is not None and wind.speed_m_s is not None,
        wind_m_s=None if wind is None else wind.speed_m_s,
        wind_from_deg=wind_from_deg(wind),
        is_clock_known=link.component.clock.is_known,
        outputs_us=ear.outputs_us(),
        is_closed_ordered=is_ordered,
        order_results=tuple(ear.results),
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
        parameters=ear.parameters,
    )

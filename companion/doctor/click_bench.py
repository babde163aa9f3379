"""Takes down what the flow meter says while one valve is opened; and the hand of a short click."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from companion.core.ground_hold import STROKES_OVER_S, Hold
from companion.core.liquid_clicks import ClickFlow
from companion.core.liquid_law import AutopilotLiquid
from companion.core.types import BatteryReport, Decision, FlowReport, Input
from companion.ground import GroundLink, HandHold
from companion.ports import Sensor

# A step comes every 0.05 s, and a hold begins with strokes over some time.
_STROKE_S = 0.1
_BEGIN_S = STROKES_OVER_S + 2.0 * _STROKE_S


@dataclass(slots=True)
class Readings:
    """Counts of the meter, and when the operator was asked to begin."""

    counts: list[FlowReport] = field(default_factory=list)
    ready_s: float = math.inf

    def take(self, items: Sequence[Input], liquid: AutopilotLiquid | None = None) -> None:
        """Keep the counts among what came in; those of the autopilot where it has the meter."""
        for item in items:
            report = item
            if liquid is not None and isinstance(item, BatteryReport):
                found = liquid.flow(item)
                report = item if found is None else found
            if isinstance(report, FlowReport):
                self.counts.append(report)

    def is_ready(self) -> None:
        """Take that the operator is asked to begin: from now on something may flow."""
        self.ready_s = time.monotonic()

    def idle(self) -> tuple[float, float]:
        """Return (volume, time) of what was counted before, with all closed; no number: unknown."""
        before = [each for each in self.counts if each.received_s <= self.ready_s]
        if len(before) < 2 or not _is_sound(before):
            return math.nan, math.nan
        volume_ml = before[-1].volume_ml - before[0].volume_ml
        return volume_ml, before[-1].received_s - before[0].received_s

    def flow(self, valve: int, open_s: float) -> ClickFlow:
        """Return what was counted from the last count before the opening to the last of all."""
        before = [each for each in self.counts if each.received_s <= self.ready_s]
        after = [each for each in self.counts if each.received_s > self.ready_s]
        if not before or not after or not _is_sound([before[-1], *after]):
            return ClickFlow(valve=valve, open_s=open_s, window_s=open_s, metered_ml=math.nan)
        return ClickFlow(
            valve=valve,
            open_s=open_s,
            window_s=max(after[-1].received_s - before[-1].received_s, open_s),
            metered_ml=after[-1].volume_ml - before[-1].volume_ml,
        )


def _is_sound(counts: Sequence[FlowReport]) -> bool:
    return all(math.isfinite(each.volume_ml) and not each.fault for each in counts)


class HeardSensor:
    """A sensor whose counts are taken down."""

    def __init__(self, sensor: Sensor, readings: Readings) -> None:
        self._sensor = sensor
        self._readings = readings

    async def open(self, wake: Callable[[], None]) -> None:
        """Take the sensor."""
        await self._sensor.open(wake)

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what it has measured."""
        found = self._sensor.read(now_s)
        self._readings.take(found)
        return found

    async def close(self) -> None:
        """Let go of it."""
        await self._sensor.close()


class HeardLink:
    """A link whose counts of the autopilot's flow meter are taken down."""

    def __init__(self, link: GroundLink, readings: Readings, liquid: AutopilotLiquid) -> None:
        self._link = link
        self._readings = readings
        self._liquid = liquid

    @property
    def fault(self) -> str | None:
        """Return why nothing reaches the vehicle."""
        return self._link.fault

    @property
    def mission_active(self) -> bool | None:
        """Return whether the vehicle says that it flies its mission."""
        return self._link.mission_active

    @property
    def rival(self) -> str | None:
        """Return who speaks on the link as we do."""
        return self._link.rival

    async def open(self, wake: Callable[[], None]) -> None:
        """Open the link."""
        await self._link.open(wake)

    def receive(self) -> Sequence[Input]:
        """Return what came in."""
        found = self._link.receive()
        self._readings.take(found, self._liquid)
        return found

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due."""
        self._link.tell(decision, now_s)

    def tell_fault(self, text: str) -> None:
        """Tell the operator of something that does not work."""
        self._link.tell_fault(text)

    def announce(self, text: str) -> None:
        """Tell the operator's ground station what is done."""
        self._link.announce(text)

    async def close(self) -> None:
        """Let go of the link."""
        await self._link.close()


class ShortHand:
    """One Enter holds for the time of a short dry click; any key, or a signal, ends it.

    Only for what is over within `HOLD_MAX_S`: everything longer wants a key that is really held.
    """

    HOLD_MAX_S = 2.0

    def __init__(
        self, hand: HandHold, *, seconds: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        if not 0.0 < seconds <= self.HOLD_MAX_S:
            raise ValueError(f"a short click takes up to {self.HOLD_MAX_S} s, got {seconds}")
        self._hand = hand
        self._seconds = seconds
        self._clock = clock
        self._hold = Hold()
        self._until_s = -math.inf

    def begin(self) -> None:
        """Begin to hold."""
        self._hand.begin()
        self._until_s = self._clock() + self._seconds + _BEGIN_S

    @property
    def hold(self) -> Hold:
        """Return the strokes so far, one more at every look."""
        now_s = self._clock()
        if now_s < self._until_s:
            self._hold = self._hold.renewed(now_s)
        return self._hold

    @property
    def stopped(self) -> str | None:
        """Return why the operator ended it."""
        return self._hand.stopped

"""A 4 to 20 mA transmitter that is sampled beside the event loop; its mean over whole periods.

A conversion takes a millisecond or two in the kernel: it is waited for in a thread, so that no
valve waits for it. What has not answered for a while is a fault.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from statistics import fmean

from companion.sensors.current_loop import CurrentLoop
from companion.sensors.voltage import VoltageSource

SILENT_S = 0.5


class Gauge:
    """Samples of one transmitter, by a task of its own."""

    def __init__(
        self,
        loop: CurrentLoop,
        source: VoltageSource,
        *,
        rate_hz: float,
        window_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loop = loop
        self._source = source
        self._rate_hz = rate_hz
        self._window_s = window_s
        self._clock = clock
        self._samples: deque[tuple[float, float]] = deque(maxlen=1000)
        self._begun_s = math.inf
        self._error = ""
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Find the converter: SensorError where there is none; then sample."""
        await asyncio.to_thread(self._source.open)
        self._begun_s = self._clock()
        self._task = asyncio.create_task(self._sample())

    async def _sample(self) -> None:
        while True:
            try:
                volts = await asyncio.to_thread(self._source.read_v)
            except OSError as error:
                self._error = f"{self._loop.name}: converter does not answer: {error}"
            else:
                self.take(self._clock(), volts)
            await asyncio.sleep(1.0 / self._rate_hz)

    def take(self, at_s: float, volts: float) -> None:
        """Take one sample."""
        self._error = ""
        self._samples.append((at_s, volts))

    def value(self, now_s: float) -> tuple[float | None, str] | None:
        """Return the mean of the last whole periods, or None and a fault; None before the first."""
        if self._error:
            return None, self._error
        while self._samples and not now_s - self._samples[0][0] <= max(self._window_s, SILENT_S):
            self._samples.popleft()
        if not self._samples:
            if not now_s - self._begun_s > SILENT_S:
                return None
            return None, f"{self._loop.name}: no reading for {SILENT_S:g} s"
        newest_s = self._samples[-1][0]
        recent = [volts for at_s, volts in self._samples if newest_s - at_s <= self._window_s]
        return self._loop.value(fmean(recent))

    async def close(self) -> None:
        """Stop sampling and let go of the converter; may be called twice and before `open`."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        self._source.close()

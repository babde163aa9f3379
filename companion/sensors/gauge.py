"""A 4 to 20 mA transmitter that is sampled beside the event loop; its mean over whole periods.

A conversion takes a millisecond or two in the kernel, and on a bus that hangs ten seconds: a thread
of its own waits for it, so that neither a valve nor the end of the process does. What has not
answered for a while is a fault.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from statistics import fmean

from companion.errors import SensorError
from companion.sensors.current_loop import CurrentLoop
from companion.sensors.voltage import VoltageSource

_logger = logging.getLogger(__name__)

SILENT_S = 0.5
# A bus that hangs is waited for so long: at the start, and at the end, where the valves are closed.
OPEN_MAX_S = 3.0
CLOSE_MAX_S = 0.5


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
        self._ending = threading.Event()
        self._ended: asyncio.Event | None = None

    async def open(self) -> None:
        """Find the converter: SensorError where there is none, or no answer; then sample."""
        opened: asyncio.Future[SensorError | None] = asyncio.get_running_loop().create_future()
        self._ending, self._ended = threading.Event(), asyncio.Event()
        # The interpreter waits for other threads at its end, and for those of a pool: not for this.
        threading.Thread(
            target=self._work,
            args=(asyncio.get_running_loop(), opened, self._ended, self._ending),
            name=f"gauge {self._loop.name}",
            daemon=True,
        ).start()
        try:
            error = await asyncio.wait_for(opened, OPEN_MAX_S)
        except TimeoutError:
            error = SensorError(
                f"{self._loop.name}: converter does not answer within {OPEN_MAX_S:g} s; check the "
                "wiring of its bus"
            )
        if error is not None:
            self._ended = None
            self._ending.set()
            raise error
        self._begun_s = self._clock()

    def _work(
        self,
        loop: asyncio.AbstractEventLoop,
        opened: asyncio.Future[SensorError | None],
        ended: asyncio.Event,
        ending: threading.Event,
    ) -> None:
        """Open, sample until the end, let go; all that may hang happens in this thread."""

        def post(call: Callable[..., object], *args: object) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(call, *args)

        try:
            self._source.open()
        except SensorError as error:
            post(_settle, opened, error)
            return
        post(_settle, opened, None)
        while not ending.is_set():
            try:
                volts = self._source.read_v()
            except OSError as error:
                post(self._failed, str(error))
            else:
                post(self.take, self._clock(), volts)
            ending.wait(1.0 / self._rate_hz)
        self._source.close()
        post(ended.set)

    def _failed(self, text: str) -> None:
        self._error = f"{self._loop.name}: converter does not answer: {text}"

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
        """Stop sampling and let go of the converter; may be called twice and before `open`.

        One that hangs is left to its thread, which ends with the process.
        """
        ended, self._ended = self._ended, None
        if ended is None:
            return
        self._ending.set()
        try:
            await asyncio.wait_for(ended.wait(), CLOSE_MAX_S)
        except TimeoutError:
            _logger.warning("%s: converter hangs, left alone", self._loop.name)


def _settle(opened: asyncio.Future[SensorError | None], error: SensorError | None) -> None:
    """Say how the opening went, if somebody still waits for it."""
    if not opened.done():
        opened.set_result(error)

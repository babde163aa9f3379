"""Edges of a GPIO line by libgpiod 2, each with the kernel's own time."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import Any

from companion.errors import SensorError
from companion.gpio_chip import find_chip, load_gpiod
from companion.sensors.pulses import Edge

# A second of pulses at 1 kHz; the kernel drops and numbers what does not fit.
BUFFER_SIZE = 1024
NANOSECONDS = 1e9


class GpiodEdges:
    """The rising edges of one line; the module is only needed where a line is."""

    def __init__(self, chip: str, line: int, *, pull: str = "as-is") -> None:
        self._chip = chip
        self._line = line
        self._pull = pull
        self._request: Any = None

    def open(self) -> None:
        """Take the line: SensorError where the module, the chip or the line is not to be had."""
        gpiod = load_gpiod(SensorError)
        bias = {
            "up": gpiod.line.Bias.PULL_UP,
            "down": gpiod.line.Bias.PULL_DOWN,
            "as-is": gpiod.line.Bias.AS_IS,
        }[self._pull]
        settings = gpiod.LineSettings(
            direction=gpiod.line.Direction.INPUT,
            edge_detection=gpiod.line.Edge.RISING,
            event_clock=gpiod.line.Clock.MONOTONIC,
            bias=bias,
        )
        try:
            self._request = gpiod.request_lines(
                find_chip(gpiod, self._chip, SensorError),
                consumer="vrspray flow meter",
                config={self._line: settings},
                event_buffer_size=BUFFER_SIZE,
            )
        except (OSError, ValueError) as error:
            raise SensorError(
                f"flow_meter.line = {self._line} on {self._chip}: {error}; see `gpioinfo` for "
                "the chip, and for who holds the line"
            ) from error

    def read(self) -> Sequence[Edge]:
        """Return the edges that the kernel has kept."""
        edges: list[Edge] = []
        while self._request is not None and self._request.wait_edge_events(timedelta(0)):
            edges += [
                Edge(event.timestamp_ns / NANOSECONDS, event.line_seqno)
                for event in self._request.read_edge_events()
            ]
        return edges

    def close(self) -> None:
        """Release the line."""
        request, self._request = self._request, None
        if request is not None:
            request.release()

"""The level of one GPIO line by libgpiod 2, with its own pull-up."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from companion.errors import SensorError
from companion.gpio_chip import find_chip, load_gpiod

_NO_WAIT = timedelta(0)


class GpiodLevel:
    """An input line; the module is only needed where a line is."""

    def __init__(self, chip: str, line: int, *, key: str) -> None:
        self._chip, self._line, self._key = chip, line, key
        self._request: Any = None
        self._high: Any = None
        self._rising: Any = None

    def open(self) -> None:
        """Take the line: SensorError where the module, the chip or the line is not to be had."""
        gpiod = load_gpiod(SensorError)
        settings = gpiod.LineSettings(
            direction=gpiod.line.Direction.INPUT,
            edge_detection=gpiod.line.Edge.BOTH,
            bias=gpiod.line.Bias.PULL_UP,
        )
        self._high = gpiod.line.Value.ACTIVE
        self._rising = gpiod.EdgeEvent.Type.RISING_EDGE
        try:
            self._request = gpiod.request_lines(
                find_chip(gpiod, self._chip, SensorError),
                consumer="vrspray",
                config={self._line: settings},
            )
        except (OSError, ValueError) as error:
            raise SensorError(
                f"{self._key} = {self._line} on {self._chip}: {error}; see `gpioinfo` for the "
                "chip, and for who holds the line"
            ) from error

    def is_high(self) -> bool:
        """Return whether the level is high or has been since the last look; OSError if unknown."""
        if self._request is None:
            raise OSError("the line is not open")
        has_risen = False
        while self._request.wait_edge_events(_NO_WAIT):
            events = self._request.read_edge_events()
            has_risen = has_risen or any(event.event_type == self._rising for event in events)
        return has_risen or bool(self._request.get_value(self._line) == self._high)

    def fileno(self) -> int | None:
        """Return the request's file, readable when the level has changed."""
        return None if self._request is None else int(self._request.fd)

    def close(self) -> None:
        """Release the line."""
        request, self._request = self._request, None
        if request is not None:
            request.release()

"""Lines of a GPIO chip through `gpiod` 2: one request, one call for all of them at an edge."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from companion import gpio_chip
from companion.errors import ActuatorError
from companion.gpio_chip import DEV

CONSUMER = "vrspray"
# Whether Raspberry Pi's kernels leave a released line at its last level ("Y") or make it an input.
PERSIST = Path("/sys/module/pinctrl_bcm2835/parameters/persist_gpio_outputs")


def load_gpiod() -> Any:
    """Return the module `gpiod`; ActuatorError where there is none, or version 1 of it."""
    return gpio_chip.load_gpiod(ActuatorError)


def find_chip(gpiod: Any, name: str, *, folder: Path | None = None) -> str:
    """Return the path of a chip by its name, path or label; ActuatorError where there is none."""
    return gpio_chip.find_chip(gpiod, name, ActuatorError, folder=folder or DEV)


def keeps_levels(path: Path = PERSIST) -> bool | None:
    """Return whether a released line keeps its level; None where the kernel does not say."""
    try:
        return path.read_text().strip().upper() in ("Y", "1")
    except OSError:
        return None


class GpiodLines:
    """The outputs of one request; levels are physical, polarity is the wiring's affair."""

    def __init__(self, gpiod: Any, chip: str, lines: Iterable[int], *, levels: int) -> None:
        self._lines = tuple(lines)
        self._value = gpiod.line.Value
        settings = gpiod.LineSettings(direction=gpiod.line.Direction.OUTPUT)
        # With the request itself: there is no moment between direction and level.
        try:
            with gpiod.Chip(find_chip(gpiod, chip)) as device:
                self._request = device.request_lines(
                    {self._lines: settings},
                    consumer=CONSUMER,
                    output_values=self._values(levels),
                )
        except ValueError as error:
            raise ActuatorError(f"{chip}: lines {self._lines}: {error}") from error

    def _values(self, levels: int) -> dict[int, Any]:
        active, inactive = self._value.ACTIVE, self._value.INACTIVE
        return {
            line: active if levels >> output & 1 else inactive
            for output, line in enumerate(self._lines)
        }

    def write(self, levels: int) -> None:
        """Drive all lines in one call."""
        self._request.set_values(self._values(levels))

    def read(self) -> int | None:
        """Return the levels of the lines."""
        values = self._request.get_values(list(self._lines))
        return sum(1 << n for n, value in enumerate(values) if value == self._value.ACTIVE)

    def release(self) -> None:
        """Release the request."""
        self._request.release()

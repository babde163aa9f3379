"""A chip of the kernel's gpio-sim: made by configfs, its pins seen and pulled by sysfs."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

CONFIG = Path("/sys/kernel/config/gpio-sim")
PLATFORM = Path("/sys/devices/platform")
# gpio-sim tells of an edge at the kernel's next tick at the latest (User-Mode-Linux: 100 a second);
# of two edges before it, it tells once.
TICK_S = 0.02
_numbers = itertools.count()


def why_not() -> str | None:
    """Return why there is no gpio-sim for us; None where there is."""
    if not CONFIG.is_dir():
        return "this kernel has no gpio-sim: make test-gpio boots one that has"
    folder = CONFIG / "vrspray-try"
    try:
        folder.mkdir()
        folder.rmdir()
    except OSError as error:
        return f"gpio-sim is not for this user ({error.strerror}): sudo make test-gpio"
    return None


class SimChip:
    """One chip, live until `remove`; a pin's pull stands for what hangs on it."""

    def __init__(self, label: str, *, count: int = 32) -> None:
        self._device = CONFIG / f"vrspray-{next(_numbers)}"
        self._bank = self._device / "bank0"
        self._device.mkdir()
        self._bank.mkdir()
        (self._bank / "num_lines").write_text(f"{count}\n")
        (self._bank / "label").write_text(label)
        (self._device / "live").write_text("1\n")
        self.label = label
        self.name = (self._bank / "chip_name").read_text().strip()
        self._pins = PLATFORM / (self._device / "dev_name").read_text().strip() / self.name

    def level(self, line: int) -> int:
        """Return the level of a pin."""
        return int((self._pins / f"sim_gpio{line}" / "value").read_text())

    def levels(self, *lines: int) -> list[int]:
        """Return the levels of pins."""
        return [self.level(line) for line in lines]

    def pull(self, line: int, *, up: bool) -> None:
        """Pull a pin; an input follows, and its edge is an event."""
        (self._pins / f"sim_gpio{line}" / "pull").write_text("pull-up" if up else "pull-down")

    def pulse(self, line: int, count: int = 1) -> None:
        """Make rising edges, as a flow meter does."""
        for _ in range(count):
            self.pull(line, up=True)
            time.sleep(TICK_S)
            self.pull(line, up=False)

    def remove(self) -> None:
        """Take the chip out of the computer, whoever holds its lines."""
        if self._device.is_dir():
            (self._device / "live").write_text("0\n")
            self._bank.rmdir()
            self._device.rmdir()

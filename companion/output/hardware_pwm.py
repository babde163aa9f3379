"""Drives on this computer's hardware PWM: the kernel's `/sys/class/pwm/pwmchipN/pwmM`, 50 Hz.

The pulses are made by hardware, and go on when this process is dead: the last speed for ever.
Whoever has a motor here has the closer after the service (`--pwm`), and a relay for the pump.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from companion.errors import ActuatorError
from companion.output.autopilot_options import DriveOutput
from companion.output.timed import TimedExecutor

_logger = logging.getLogger(__name__)

SYSFS = Path("/sys/class/pwm")
PERIOD_NS = 20_000_000
# udev needs a moment to hand a new output over.
EXPORT_MAX_S = 1.0
_LOOK_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class PwmDrive:
    """A motor on one output of a chip; `drive.channel` is the output's number."""

    chip: int
    drive: DriveOutput

    def folder(self, root: Path) -> Path:
        """Return where the kernel shows it."""
        return root / f"pwmchip{self.chip}" / f"pwm{self.drive.channel}"


class HardwarePwmExecutor(TimedExecutor):
    """Follows the drives of the plans; it has no valves. What cannot be written is a fault."""

    def __init__(self, drives: tuple[PwmDrive, ...], *, root: Path = SYSFS) -> None:
        super().__init__(0, drive_count=len(drives))
        self._drives = drives
        self._root = root
        self._pulse_us: list[int | None] = [None] * len(drives)
        self._fault: str | None = None
        self._is_ready = False

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; it stays."""
        return self._fault

    @property
    def is_guarded(self) -> bool:
        """Whether something stops them when this computer fails: its pins then carry nothing."""
        return True

    async def start(self) -> None:
        """Take the outputs and have all of them pulse at stop.

        Raises:
            ActuatorError: an output is not there, or may not be written.
        """
        for drive in self._drives:
            try:
                await self._take(drive)
            except OSError as error:
                self._let_go()
                raise ActuatorError(
                    f"hardware PWM {drive.folder(self._root)}: {error.strerror or error}; see that "
                    "the overlay is loaded (dtoverlay=pwm-2chan) and the file may be written"
                ) from error
        self._is_ready = True
        await super().start()

    async def stop(self) -> None:
        """Have all stop, and switch the pulses off: an ESC without any stops too."""
        if not self._is_ready:
            return
        await super().stop()
        self._is_ready = False
        self._let_go()

    # ------------------------------------------------------------------------------- inside

    async def _take(self, drive: PwmDrive) -> None:
        folder = drive.folder(self._root)
        if not folder.is_dir():
            (folder.parent / "export").write_text(str(drive.drive.channel))
        until_s = asyncio.get_running_loop().time() + EXPORT_MAX_S
        while not _is_writable(folder / "enable"):
            if not asyncio.get_running_loop().time() < until_s:
                break  # the write below says what is wrong
            await asyncio.sleep(_LOOK_S)
        with suppress(OSError):
            # A pulse of before that is longer than the new period would refuse it.
            (folder / "duty_cycle").write_text("0")
        (folder / "period").write_text(str(PERIOD_NS))
        (folder / "duty_cycle").write_text(str(1000 * drive.drive.stop_us))
        (folder / "enable").write_text("1")

    def _apply(self, valve: int, duty: float) -> bool:
        pulse_us = self._drives[valve].drive.pulse_us(duty)
        if not self._is_ready or self._pulse_us[valve] == pulse_us:
            return False
        folder = self._drives[valve].folder(self._root)
        try:
            (folder / "duty_cycle").write_text(str(1000 * pulse_us))
        except OSError as error:
            self._pulse_us[valve] = None
            if self._fault is None:
                self._fault = f"hardware PWM {folder.name}: {error.strerror or error}"
                _logger.error("%s", self._fault)
            return False
        self._pulse_us[valve] = pulse_us
        return True

    def _let_go(self) -> None:
        for drive in self._drives:
            folder = drive.folder(self._root)
            with suppress(OSError):
                (folder / "duty_cycle").write_text(str(1000 * drive.drive.stop_us))
            with suppress(OSError):
                (folder / "enable").write_text("0")


def _is_writable(path: Path) -> bool:
    try:
        with path.open("r+"):
            return True
    except OSError:
        return False

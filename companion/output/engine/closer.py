"""The independent closer: drives lines to given levels and ends.

For `ExecStopPost` of the service, which runs after every end of it, crash and watchdog included:
`python -P -m companion.output.engine.closer --chip gpiochip0 --low 17 18 --high 22`, or for a shift
register `--spi /dev/spidev0.0 --bytes 000008`. Motors on hardware PWM, which pulses on by itself,
are stopped by `--pwm 0:1:1000` (chip, output, microseconds of stop). It needs no configuration, no
file and nothing of the companion, so that it works where those are the trouble.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from companion.errors import ActuatorError
from companion.output.engine.lines import GpiodLines, Lines, SpiRegister, load_gpiod, open_port
from companion.output.engine.wire import EngineSetup

# An engine that is just dying still holds its lines.
PATIENCE_S = 2.0
_PAUSE_S = 0.02
T = TypeVar("T")


def closer_arguments(setup: EngineSetup) -> list[str]:
    """Return the arguments with which the closer makes these outputs safe.

    >>> from companion.core.types import PwmLimits
    >>> from companion.output.engine.wire import Wiring
    >>> pwm = PwmLimits(frequency_hz=11, duty_min=0.2, duty_max=0.9, min_on_s=0, min_off_s=0)
    >>> wiring = Wiring(valves=(17, 18), return_line=22, return_normally_open=False)
    >>> closer_arguments(EngineSetup(wiring=wiring, pwm=pwm))
    ['--chip', 'gpiochip0', '--low', '17', '18', '--high', '22']
    """
    wiring = setup.wiring
    ends: dict[bool, list[str]] = {False: [], True: []}
    for output, line in enumerate(wiring.lines):
        ends[bool(wiring.safe_levels >> output & 1)].append(str(line))
    if setup.backend == "spi595":
        high = [int(line) for line in ends[True]]
        length = max(wiring.lines) // 8 + 1
        word = sum(1 << line for line in high).to_bytes(length, "big")
        return ["--spi", setup.device, "--bytes", word.hex()]
    low, high_lines = ends[False], ends[True]
    arguments = ["--chip", setup.device]
    arguments += ["--low", *low] if low else []
    return arguments + (["--high", *high_lines] if high_lines else [])


def main(arguments: Sequence[str]) -> int:
    """Close; return 0 when the levels were written."""
    parser = argparse.ArgumentParser(
        prog="closer",
        description="Drive lines to their safe levels.",
        epilog="Example: python -P -m companion.output.engine.closer --chip gpiochip0 --low 17 18",
    )
    parser.add_argument("--chip", default="gpiochip0", help="name, path or label of the chip")
    parser.add_argument("--low", type=int, nargs="*", default=[], metavar="LINE")
    parser.add_argument("--high", type=int, nargs="*", default=[], metavar="LINE")
    parser.add_argument("--spi", metavar="DEVICE", help="a shift register instead of lines")
    parser.add_argument("--bytes", type=bytes.fromhex, default=b"", metavar="HEX")
    parser.add_argument("--pwm", nargs="*", default=[], metavar="CHIP:OUTPUT:STOP_US")
    parser.add_argument("--pwm-root", type=Path, default=Path("/sys/class/pwm"), metavar="DIR")
    given = parser.parse_args(arguments)
    lines = [*given.low, *given.high]
    if not (given.bytes if given.spi else lines) and not given.pwm:
        parser.error("nothing to close: name lines, or the bytes of a register")
    # The motors first: a pump is not to work against closed valves.
    failed = [each for each in given.pwm if not _stop_motor(given.pwm_root, each)]
    if not (given.bytes if given.spi else lines):
        return int(bool(failed))
    try:
        if given.spi:
            _patiently(lambda: _close_register(given.spi, given.bytes))
        else:
            high = ((1 << len(given.high)) - 1) << len(given.low)
            held = _patiently(lambda: _open_lines(given.chip, lines, high))
            held.release()
    except (OSError, ActuatorError) as error:
        sys.stderr.write(f"closer: {error}\n")
        return 1
    return int(bool(failed))


def _stop_motor(root: Path, motor: str) -> bool:
    """Give a motor its pulse of stop, then none; False where that cannot be done."""
    try:
        chip, output, stop_us = (int(part) for part in motor.split(":"))
        folder = root / f"pwmchip{chip}" / f"pwm{output}"
        if not folder.is_dir():
            return True  # never taken: it does not pulse
        (folder / "duty_cycle").write_text(str(1000 * stop_us))
        (folder / "enable").write_text("0")
    except (OSError, ValueError) as error:
        sys.stderr.write(f"closer: --pwm {motor}: {error}\n")
        return False
    return True


def _open_lines(chip: str, lines: Sequence[int], levels: int) -> Lines:
    return GpiodLines(load_gpiod(), chip, lines, levels=levels)


def _close_register(device: str, data: bytes) -> None:
    levels = int.from_bytes(data, "big")
    SpiRegister(open_port(device, 1_000_000), range(8 * len(data)), levels=levels).release()


def _patiently(do: Callable[[], T]) -> T:
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return do()
        except OSError:
            if not time.monotonic() < end_s:
                raise
        time.sleep(_PAUSE_S)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

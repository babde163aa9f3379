"""The independent closer: drives lines to given levels and ends.

For `ExecStopPost` of the service, which runs after every end of it, crash and watchdog included:
`python -m companion.output.engine.closer --chip gpiochip0 --low 17 18 --high 22`, or for a shift
register `--spi /dev/spidev0.0 --bytes 000008`. It needs no configuration, no file and nothing of
the companion, so that it works where those are the trouble.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from companion.errors import ActuatorError
from companion.output.engine.gpiod_lines import GpiodLines, load_gpiod
from companion.output.engine.lines import Lines
from companion.output.engine.setup import EngineSetup
from companion.output.engine.spi595 import SpiRegister, open_port

# An engine that is just dying still holds its lines.
PATIENCE_S = 2.0
_PAUSE_S = 0.02
T = TypeVar("T")


def closer_arguments(setup: EngineSetup) -> list[str]:
    """Return the arguments with which the closer makes these outputs safe.

    >>> from companion.core.nozzle import PwmLimits
    >>> from companion.output.engine.wiring import Wiring
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
        epilog="Example: python -m companion.output.engine.closer --chip gpiochip0 --low 17 18",
    )
    parser.add_argument("--chip", default="gpiochip0", help="name, path or label of the chip")
    parser.add_argument("--low", type=int, nargs="*", default=[], metavar="LINE")
    parser.add_argument("--high", type=int, nargs="*", default=[], metavar="LINE")
    parser.add_argument("--spi", metavar="DEVICE", help="a shift register instead of lines")
    parser.add_argument("--bytes", type=bytes.fromhex, default=b"", metavar="HEX")
    given = parser.parse_args(arguments)
    lines = [*given.low, *given.high]
    if not (given.bytes if given.spi else lines):
        parser.error("nothing to close: name lines, or the bytes of a register")
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
    return 0


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

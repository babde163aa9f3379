"""`vrspray` with a chip of files: `python -m tests.bench.faults.launcher FOLDER run ...`.

Everything is the real thing but the object that writes to the lines. As `... launcher --engine
FOLDER FD PARENT` it is the valve engine of such a companion.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from companion.errors import ActuatorError
from companion.output.engine import lines
from companion.output.engine.lines import Lines
from companion.output.engine.wire import EngineSetup
from tests.bench.faults.chip import Chip, ChipLines

_MODULE = "tests.bench.faults.launcher"


def engine_command(folder: Path) -> tuple[str, ...]:
    """Return the command of the engine; the companion adds socket and parent."""
    return (sys.executable, "-m", _MODULE, "--engine", str(folder))


def companion_command(folder: Path, arguments: Sequence[str]) -> tuple[str, ...]:
    """Return the command of a companion whose lines are in `folder`."""
    return (sys.executable, "-m", _MODULE, str(folder), *arguments)


def _use(chip: Chip) -> None:
    """Have everybody who opens lines get those of `chip`: whoever does is imported later."""

    def open_lines(setup: EngineSetup) -> Lines:
        try:
            return ChipLines(chip, levels=setup.wiring.safe_levels)
        except OSError as error:
            raise ActuatorError(f"{setup.device}: {error.strerror}") from error

    lines.open_lines = open_lines


def main(arguments: Sequence[str]) -> int:
    """Be the companion, or its engine."""
    is_engine = arguments[0] == "--engine"
    folder, *rest = arguments[is_engine:]
    _use(Chip(Path(folder)))
    if is_engine:
        from companion.output.engine import process

        return process.main(rest)
    from companion.cli import output_parts
    from companion.cli.app import execute
    from companion.config import Config
    from companion.output.gpio import GpioExecutor

    def build_gpio(config: Config) -> GpioExecutor:
        return GpioExecutor(output_parts.engine_setup(config), command=engine_command(Path(folder)))

    # The command that puts a companion together is imported when it is run.
    output_parts.build_gpio = build_gpio
    return execute(rest)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

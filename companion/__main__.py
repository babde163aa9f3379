"""The program `vrspray`, and `python -m companion`: Ctrl-C is one line from the first moment on.

The imports of the program take some tenths of a second, in which an interrupt would print where it
hit.
"""

from __future__ import annotations

import os
import signal
from types import FrameType

# As `companion.cli.app.INTERRUPTED`, which is not imported yet.
_INTERRUPTED = 130


def main() -> None:
    """Run the command line of this process and leave with its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    from companion.cli import main as run

    run()


def _leave(_number: int, _frame: FrameType | None) -> None:
    # Nothing is open yet; an exception in the middle of an import could be caught by a library.
    os.write(2, b"interrupted\n")
    os._exit(_INTERRUPTED)


if __name__ == "__main__":
    main()

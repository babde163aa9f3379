"""In every Python that a test starts: what it leaves open is written down for the test to see.

So is what is imported for the first time while the control loop turns: that holds the loop up,
maybe with valves open. A flight's processes go by its clock (`fair_clock.py`). `tests/conftest.py`
puts this folder on the path of child processes and names the places.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_folder = os.environ.get("VRSPRAY_LEFT_OPEN")


def _tell(text: str) -> None:
    if _folder is not None:
        with (Path(_folder) / str(os.getpid())).open("a") as file:
            file.write(f"{' '.join(sys.orig_argv[1:])[:200]}: {text}\n")


def _note(found: UnraisableHookArgs) -> None:
    if isinstance(found.exc_value, ResourceWarning):
        _tell(str(found.exc_value))
    sys.__unraisablehook__(found)


def _hear(event: str, details: tuple[object, ...]) -> None:
    """Tell of an import that finds its module not loaded, between first step and end of a run."""
    if event == "import" and "companion.runtime" in sys.modules and _is_turning():
        _tell(f"{details[0]} was imported in flight")


def _is_turning() -> bool:
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        code = frame.f_code
        if code.co_name == "execute" and code.co_filename.endswith("companion/runtime.py"):
            return any(
                type(each).__name__ == "ControlLoop" and each._stepped_s > 0.0
                for each in gc.get_objects()
            )
        frame = frame.f_back
    return False


# Before anything else has asked for the time. A flight that is over has no clock any more.
if (_clock := os.environ.get("VRSPRAY_FAIR_CLOCK")) and __name__ == "sitecustomize":
    with suppress(OSError):
        from fair_clock import FairClock

        FairClock(Path(_clock)).rule()

# Not where pytest looks through the modules for doctests.
if _folder is not None and __name__ == "sitecustomize":
    warnings.simplefilter("error", ResourceWarning)
    sys.unraisablehook = _note
    sys.addaudithook(_hear)

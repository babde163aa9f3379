"""In every Python that a test starts: what it leaves open is written down for the test to see.

`tests/conftest.py` puts this folder on the path of child processes and names the place.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_folder = os.environ.get("VRSPRAY_LEFT_OPEN")


def _note(found: UnraisableHookArgs) -> None:
    if isinstance(found.exc_value, ResourceWarning) and _folder is not None:
        with (Path(_folder) / str(os.getpid())).open("a") as file:
            file.write(f"{' '.join(sys.orig_argv[1:])[:200]}: {found.exc_value}\n")
    sys.__unraisablehook__(found)


# Not where pytest looks through the modules for doctests.
if _folder is not None and __name__ == "sitecustomize":
    warnings.simplefilter("error", ResourceWarning)
    sys.unraisablehook = _note

"""The module `gpiod` and the chips that it knows, for all who use lines of this computer."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from companion.errors import VrsprayError
from companion.wording import install_command

DEV = Path("/dev")


def load_gpiod(error_type: type[VrsprayError]) -> Any:
    """Return the module `gpiod`; an error where there is none, or version 1 of it."""
    try:
        gpiod = importlib.import_module("gpiod")
    except ImportError as error:
        raise error_type(
            f"the Python package gpiod is missing: {install_command('vehicle')}"
        ) from error
    version = str(getattr(gpiod, "__version__", "1"))
    if not version.partition(".")[0].isdigit() or int(version.partition(".")[0]) < 2:
        # Debian 12's own package is version 1 under the same name, with another interface.
        raise error_type(f"gpiod {version} is too old: {install_command('vehicle')}")
    return gpiod


def find_chip(
    gpiod: Any, name: str, error_type: type[VrsprayError], *, folder: Path | None = None
) -> str:
    """Return the path of a chip by its name, path or label.

    A label (`pinctrl-bcm2711`, `pinctrl-rp1`) is the safest: the number of a Raspberry Pi 5's
    chip has changed with its kernels.
    """
    folder = folder or DEV
    path = folder / name
    if path.exists():
        return str(path)
    labels = []
    for other in sorted(folder.glob("gpiochip*")):
        with gpiod.Chip(str(other)) as chip:
            label = chip.get_info().label
        if label == name:
            return str(other)
        labels.append(f"{other.name} ({label})")
    raise error_type(f"no GPIO chip {name}; there are: " + (", ".join(labels) or "none"))

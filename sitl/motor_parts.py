"""What a configuration says of its motors, as a simulated flight needs it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.droplets import droplet_share
from companion.errors import ConfigError

if TYPE_CHECKING:
    from companion.config import Config
    from companion.core.setup import Setup
    from sitl.drives import DriveTruth, Ranges
    from sitl.profile import PlantProfile


def ranges_us(config: Config) -> Ranges:
    """Return stop and full pulse of the pump, if there is one, and of each atomiser."""
    found = [] if config.pump is None else [(config.pump.stop_us, config.pump.max_us)]
    found += [(table.stop_us, table.us[-1]) for table in config.atomiser]
    return tuple((float(stop_us), float(full_us)) for stop_us, full_us in found)


def kind_of(setup: Setup) -> tuple[str | None, int]:
    """Return what the pump does, None without one, and how many atomisers there are."""
    return (None if setup.pump is None else setup.pump.control), len(setup.atomisers)


def fits(profile: PlantProfile, setup: Setup) -> bool:
    """Return whether a sprayer has the motors that the program drives."""
    supply = profile.supply
    own = (None if supply is None else supply.control, len(profile.atomisers))
    return own == kind_of(setup)


def check_motors(profile: PlantProfile, setup: Setup, name: str) -> None:
    """Refuse a sprayer whose motors are not those of the configuration."""
    if not fits(profile, setup):
        has = (
            None if profile.supply is None else profile.supply.control,
            len(profile.atomisers),
        )
        raise ConfigError(
            f"--plant {name}: it has {_say(*has)}, the configuration {_say(*kind_of(setup))}"
        )


def _say(control: str | None, atomisers: int) -> str:
    pump = {None: "no pump of its own", "modulates": "a pump that modulates"}
    return f"{pump.get(control, 'a constant pump')} and {atomisers} atomisers"


def droplet_figures(setup: Setup, truth: DriveTruth | None) -> list[dict[str, Any]]:
    """Return the droplet figures of each atomiser."""
    if truth is None:
        return []
    found = []
    for number, (wanted, real) in enumerate(zip(setup.atomisers, truth.atomisers, strict=True)):
        column = np.s_[:, number : number + 1]
        share = droplet_share(
            truth.volume_ml[column], truth.vmd_um[column], wanted_um=wanted.droplet_um
        )
        found.append({"atomiser": real.name, **asdict(share)})
    return found

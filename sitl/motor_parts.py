"""What a configuration says of its motors, as a simulated flight needs it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

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


# How much of the liquid left the atomisers as droplets of the wanted class.
#
# The classes are those of ASABE S572, with the volume median diameters that extension services
# print beside them (the standard itself goes by reference nozzles). Liquid that leaves an
# atomiser that does not turn is in none.

# Least and largest median diameter [um] of each class.
CLASSES = {
    "very fine": (61.0, 106.0),
    "fine": (106.0, 236.0),
    "medium": (236.0, 341.0),
    "coarse": (341.0, 404.0),
    "very coarse": (404.0, 503.0),
    "extremely coarse": (503.0, 666.0),
}
# A class is wide: so near to the wanted diameter is another figure.
NEAR = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class DropletShare:
    """Shares of the volume, in the class of the wanted diameter and within 15 % of it; the mean."""

    wanted_um: float
    droplet_class: str | None
    in_class_percent: float | None
    near_percent: float | None
    mean_vmd_um: float | None


def class_of(vmd_um: float) -> str | None:
    """Return the class that a median diameter lies in.

    >>> class_of(180.0), class_of(9.0)
    ('fine', None)
    """
    return next((name for name, (low, high) in CLASSES.items() if low <= vmd_um < high), None)


def droplet_share(
    volume_ml: NDArray[np.float64], vmd_um: NDArray[np.float64], *, wanted_um: float
) -> DropletShare:
    """Return the figures; both arrays are (samples, atomisers), the volume is cumulative.

    >>> volume = np.array([[0.0], [1.0], [2.0], [4.0]])
    >>> share = droplet_share(volume, np.array([[180.0], [180.0], [210.0], [410.0]]), wanted_um=200)
    >>> share.droplet_class, share.in_class_percent, share.near_percent, share.mean_vmd_um
    ('fine', 50.0, 50.0, 302.5)
    """
    drops_ml, drops_um = np.diff(volume_ml, axis=0), vmd_um[1:]
    total_ml = float(drops_ml.sum())
    known = np.isfinite(drops_um)
    known_ml = float(drops_ml[known].sum())
    name = class_of(wanted_um)

    def percent(low_um: float, high_um: float) -> float | None:
        inside = known & (drops_um >= low_um) & (drops_um < high_um)
        return 100.0 * float(drops_ml[inside].sum()) / total_ml if total_ml else None

    return DropletShare(
        wanted_um=wanted_um,
        droplet_class=name,
        in_class_percent=None if name is None else percent(*CLASSES[name]),
        near_percent=percent((1.0 - NEAR) * wanted_um, (1.0 + NEAR) * wanted_um),
        mean_vmd_um=float(drops_ml[known] @ drops_um[known]) / known_ml if known_ml else None,
    )

"""How far droplets land from below their nozzle, beside how far the controller expects them.

The truths are sprayers and air that are as the controller was told, and otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.core.drift import Drift, fall_s
from sitl.ballistics import Air, Landing, fall, spectrum_um

SPEED_M_S = 5.0
WIND_M_S = 2.0
# What the controller is told of the sprayer: the defaults of [drift], and the boom's height.
DROPLET_UM, HEIGHT_M, DOWNWASH_M_S = 250.0, 3.5, 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """How droplets really fall: by default as the controller assumes."""

    label: str
    droplet_um: float = DROPLET_UM
    height_m: float = HEIGHT_M
    downwash_m_s: float = DOWNWASH_M_S
    roughness_m: float = 0.0
    wind_m_s: float = WIND_M_S
    turned_deg: float = 0.0
    classes: int = 9

    def landing(self, wind_m_s: tuple[float, float], velocity_m_s: tuple[float, float]) -> Landing:
        """Return where the droplets land in a wind at the nozzles, class by class."""
        return fall(
            spectrum_um(self.droplet_um, self.classes),
            height_m=self.height_m,
            velocity_m_s=velocity_m_s,
            air=Air(
                wind_east_m_s=wind_m_s[0],
                wind_north_m_s=wind_m_s[1],
                downwash_m_s=self.downwash_m_s,
                roughness_m=self.roughness_m,
            ),
        )


TRUTHS = (
    Truth(label="one size, 250 um: the model itself", classes=1),
    Truth(label="as assumed, a spectrum about 250 um"),
    Truth(label="height 2.5 m", height_m=2.5),
    Truth(label="height 4.5 m", height_m=4.5),
    Truth(label="median 150 um", droplet_um=150.0),
    Truth(label="median 400 um", droplet_um=400.0),
    Truth(label="downwash 6 m/s", downwash_m_s=6.0),
    Truth(label="downwash 10 m/s", downwash_m_s=10.0),
    Truth(label="wind fades over short grass (0.03 m)", roughness_m=0.03),
    Truth(label="wind fades over a crop (0.10 m)", roughness_m=0.10),
    Truth(label="wind is 1 m/s", wind_m_s=1.0),
    Truth(label="wind is 3 m/s", wind_m_s=3.0),
    Truth(label="wind is 30 degrees off", turned_deg=30.0),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shift:
    """How far from below its nozzle the liquid lands, and from where the controller expects it.

    Wind from the side, so that the carry along the course is apart. `low_m` and `high_m` hold the
    middle eight ninths of the volume.
    """

    label: str
    shift_m: float
    low_m: float
    high_m: float
    carry_m: float
    left_m: float


def law() -> Drift:
    """Return the controller's model with the defaults of its configuration."""
    return Drift(fall_s=fall_s(DROPLET_UM, HEIGHT_M, downwash_m_s=DOWNWASH_M_S))


def shift_of(truth: Truth) -> Shift:
    """Return the shift at 5 m/s to the north, told of 2 m/s of wind to the east."""
    turned = math.radians(truth.turned_deg)
    wind = (truth.wind_m_s * math.cos(turned), truth.wind_m_s * math.sin(turned))
    landed = truth.landing(wind, (0.0, SPEED_M_S))
    given = law()
    east_m, north_m = float(landed.east_m.mean()), float(landed.north_m.mean())
    return Shift(
        label=truth.label,
        shift_m=east_m,
        low_m=float(landed.east_m.min()),
        high_m=float(landed.east_m.max()),
        carry_m=north_m,
        left_m=math.hypot(east_m - WIND_M_S * given.fall_s, north_m - given.forward_carry_m),
    )

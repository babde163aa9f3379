"""Which plant simulates a profile: by what makes its flow, and by how finely it is looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.plant import AveragedPlant, PulsedPlant
from sitl.pump_plant import PumpPlant
from sitl.section_plant import SectionPlant
from sitl.supplied_plant import SuppliedAveraged, SuppliedPulsed

if TYPE_CHECKING:
    from sitl.profile import PlantProfile

DutyPlant = AveragedPlant | PumpPlant | SectionPlant
EdgePlant = PulsedPlant | SectionPlant


def duty_plant(profile: PlantProfile, *, seed: int, start_s: float) -> DutyPlant:
    """Return the plant of the mean flow: it takes changes of duty."""
    if profile.pump is not None:
        return PumpPlant(profile, seed=seed, start_s=start_s)
    if profile.has_sections:
        return SectionPlant(profile, seed=seed, start_s=start_s)
    if profile.supply is not None:
        return SuppliedAveraged(profile, seed=seed, start_s=start_s)
    return AveragedPlant(profile, seed=seed, start_s=start_s)


def edge_plant(profile: PlantProfile, *, seed: int, start_s: float) -> EdgePlant:
    """Return the plant that takes edges."""
    if profile.has_sections:
        return SectionPlant(profile, seed=seed, start_s=start_s)
    if profile.supply is not None:
        return SuppliedPulsed(profile, seed=seed, start_s=start_s)
    return PulsedPlant(profile, seed=seed, start_s=start_s)

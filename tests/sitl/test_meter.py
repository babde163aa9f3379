from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.output.pwm import Edge
from sitl.plant import AveragedPlant, Plant, PulsedPlant
from sitl.profile import load_profile

PROFILE = load_profile("wang-2024")
NOISY = replace(PROFILE, meter=replace(PROFILE.meter, noise=0.05))


def changes(plant: AveragedPlant, at_s: float) -> None:
    number = round(at_s * 5.0)
    plant.record_change(at_s, number % 6, (number * 0.37) % 1.0 if number % 4 else 0.0)


def edges(plant: PulsedPlant, at_s: float) -> None:
    number = round(at_s * 5.0)
    plant.record(
        Edge(at_s=at_s + 0.01 * valve, valve=valve, is_open=number % 2 == 0, duty=0.5)
        for valve in range(6)
    )


@pytest.mark.parametrize("fidelity", ["averaged", "pulsed"])
@pytest.mark.parametrize("rate_hz", [7.0, 50.0, 333.0])
def test_the_meter_read_in_passing_counts_as_the_one_read_afterwards(
    fidelity: str, rate_hz: float
) -> None:
    plant: Plant
    if fidelity == "averaged":
        plant = AveragedPlant(NOISY, seed=3, start_s=-1.0)
    else:
        plant = PulsedPlant(NOISY, seed=3, start_s=-1.0)
    plant.stick(-1.0, 1, is_open=True)
    counter = plant.meter_counter()
    times_s = np.arange(0.0, 40.0, 1.0 / rate_hz)
    seen, at_s = [], 0.0
    for time_s in times_s.tolist():
        while at_s <= time_s:
            if isinstance(plant, AveragedPlant):
                changes(plant, at_s)
            elif isinstance(plant, PulsedPlant):
                edges(plant, at_s)
            at_s += 0.2
        seen.append(counter(time_s))
    assert seen == plant.meter_count(times_s).tolist()
    assert seen[-1] > 1000

"""The sprayers that are flown: each with its own curve, PWM and lags behind one controller.

The nominal lags were measured beforehand on other sprayers of the make: `examples/anyang/lags` and
`sitl/profiles/lags` say how.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from companion.core.schedule import LagModel
from companion.core.setup import Setup
from sitl.anyang import MAP_SPEED_M_S, PLANT, demo_lags, demo_setup
from sitl.flight import FlightOptions
from sitl.knowledge import perfect_setup, with_sprayer
from sitl.profile import PlantProfile, load_profile

Output = Literal["gpio", "servo", "free-running"]
BOTH: tuple[Literal["gpio", "servo"], ...] = ("gpio", "servo")
OUTPUTS: tuple[Output, ...] = ("gpio", "servo", "free-running")
PLANTS = (PLANT, "pinpoint")
KINDS = ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s")


def sprayer_setup(plant: str, output: Output, speed_m_s: float = MAP_SPEED_M_S) -> Setup:
    """Return the example with this sprayer, its rates scaled by 5/V, and the nominal lags."""
    setup = replace(
        demo_setup(speed_m_s), lag=nominal_lag(plant, output), centres_pulses=output == "gpio"
    )
    return setup if plant == PLANT else with_sprayer(setup, load_profile(plant))


def nominal_lag(plant: str, output: Output) -> LagModel:
    """Return the lags measured beforehand for an output path."""
    return demo_lags("gpio" if output == "gpio" else "servo", plant)


def known_setup(setup: Setup, profile: PlantProfile, output: Output, seed: int) -> Setup:
    """Return a set-up that knows the very sprayer of a seed, and the output path's mean delay."""
    output_s = nominal_lag(profile.name, output).output_s
    return perfect_setup(setup, profile, seed=seed, output_s=output_s)


def scaled_lag(lag: LagModel, factor: float) -> LagModel:
    """Return lags that are wrong by a factor; output path and position stay."""
    return replace(lag, **{name: factor * getattr(lag, name) for name in KINDS})


def scaled_flow(profile: PlantProfile, gain: float) -> PlantProfile:
    """Return a sprayer that delivers `gain` times what the measured table says."""
    sets = tuple(
        replace(nozzles, flow_l_min=tuple(gain * flow for flow in nozzles.flow_l_min))
        for nozzles in profile.nozzle_sets
    )
    return replace(profile, nozzle_sets=sets)


def options_of(output: Output, seed: int) -> FlightOptions:
    """Return how a flight through an output is simulated."""
    if output == "gpio":
        return FlightOptions(seed=seed, output="gpio")
    board: Literal["restarting", "free-running"]
    board = "free-running" if output == "free-running" else "restarting"
    return FlightOptions(seed=seed, output="servo", board=board)

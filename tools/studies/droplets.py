"""Where the deposit lands in wind, with and without the controller's offset: the check of it.

    python -m tools.studies.droplets

The first table compares the controller's offset with ballistic droplets
that fall as assumed, and otherwise. The second flies the field of Wang et al. 2024 with and
without the offset, moves the liquid to where its droplets land, and judges the ground.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from statistics import NormalDist, fmean
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from analysis.border import off_target_ml
from analysis.evaluation import evaluate
from analysis.flight_record import Fidelity, FlightRecord
from analysis.strips import strips_of
from companion.cli.answer import AsJson, answer
from companion.core.options.drift import Drift, fall_s
from companion.core.types import Input, WindReport
from sitl.anyang import demo_lags, demo_setup, demo_trajectory
from sitl.conditions import on_ground
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile

# How far droplets land from below their nozzle, beside how far the controller expects them.
#
# The truths are sprayers and air that are as the controller was told, and otherwise.

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


PROFILE = "wang-2024"
WIND_RATE_HZ = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Weather:
    """A steady wind along and across the passes, and how the droplets fall in it."""

    label: str
    along_m_s: float
    across_m_s: float
    truth: Truth = TRUTHS[1]


WEATHERS = (
    Weather(label="still air", along_m_s=0.0, across_m_s=0.0),
    Weather(label="2 m/s along the passes", along_m_s=WIND_M_S, across_m_s=0.0),
    Weather(label="2 m/s across", along_m_s=0.0, across_m_s=WIND_M_S),
    Weather(label="2 m/s at 45 degrees", along_m_s=2.0**0.5, across_m_s=2.0**0.5),
    Weather(
        label="2 m/s along, fading (0.03 m)",
        along_m_s=WIND_M_S,
        across_m_s=0.0,
        truth=Truth(label="fading", roughness_m=0.03),
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """How well the ground was served, with the liquid where it landed; means over the seeds.

    `lag_` is at the mean place of the droplets; `off_target_ml` is over all their sizes.
    """

    label: str
    corrected: bool
    lag_mean_abs_m: float
    lag_worst_m: float
    misapplied_percent: float
    off_target_ml: float
    applied_ml: float


def ground_of(
    weather: Weather, *, corrected: bool, seeds: Iterable[int], fidelity: Fidelity
) -> Ground:
    """Return the figures of the flights of some seeds in one weather."""
    wind = on_ground(demo_setup(SPEED_M_S).frame, weather.along_m_s, weather.across_m_s)
    ahead = on_ground(demo_setup(SPEED_M_S).frame, SPEED_M_S, 0.0)
    ways = [weather.truth.landing(wind, (sign * ahead[0], sign * ahead[1])) for sign in (1, -1)]
    lags, worst, misapplied, outside, applied = [], [], [], [], []
    for seed in seeds:
        record = flown(wind, corrected=corrected, seed=seed, fidelity=fidelity)
        found = evaluate(landed(record, ways, ahead))
        lags.append(found.lag_distance_m.mean_abs or 0.0)
        worst.append(found.lag_distance_m.max_abs or 0.0)
        misapplied.append(found.misapplied_percent or 0.0)
        applied.append(found.applied_ml)
        for size in range(len(ways[0].east_m)):
            one = landed(record, ways, ahead, size=size)
            outside.append(off_target_ml(strips_of(one), one.prescription))
    return Ground(
        label=weather.label,
        corrected=corrected,
        lag_mean_abs_m=fmean(lags),
        lag_worst_m=max(worst),
        misapplied_percent=fmean(misapplied),
        off_target_ml=fmean(outside),
        applied_ml=fmean(applied),
    )


def flown(
    wind_m_s: tuple[float, float], *, corrected: bool, seed: int, fidelity: Fidelity
) -> FlightRecord:
    """Return the truth of a flight whose controller hears of the wind at the nozzles."""
    profile, setup = load_profile(PROFILE), demo_setup(SPEED_M_S)
    result = fly(
        replace(setup, lag=demo_lags("gpio"), drift=law() if corrected else None),
        demo_trajectory(SPEED_M_S, seed),
        profile,
        FlightOptions(fidelity=fidelity, seed=seed),
        speed_m_s=SPEED_M_S,
        disturb=lambda items: with_wind(items, wind_m_s),
    )
    return result.record


def with_wind(items: Iterator[Input], wind_m_s: tuple[float, float]) -> Iterator[Input]:
    """Yield the inputs with a report of the wind every half second."""
    due_s = -math.inf
    for item in items:
        if item.received_s >= due_s:
            due_s = item.received_s + 1.0 / WIND_RATE_HZ
            yield WindReport(
                received_s=item.received_s,
                speed_m_s=math.hypot(*wind_m_s),
                east_m_s=wind_m_s[0],
                north_m_s=wind_m_s[1],
            )
        yield item


def landed(
    record: FlightRecord,
    ways: list[Landing],
    ahead: tuple[float, float],
    *,
    size: int | None = None,
) -> FlightRecord:
    """Return the flight with the path that would have put its liquid straight below.

    `ways` are the landings of a pass ahead and of one back; all sizes land at their mean place,
    or only one is asked for.
    """
    chosen = slice(None) if size is None else slice(size, size + 1)
    gained = np.gradient(record.east_m) * ahead[0] + np.gradient(record.north_m) * ahead[1]
    moved = [
        np.where(gained >= 0.0, *(float(getattr(way, name)[chosen].mean()) for way in ways))
        for name in ("east_m", "north_m")
    ]
    return replace(record, east_m=record.east_m + moved[0], north_m=record.north_m + moved[1])


def tables(shifts: Iterable[Shift], grounds: Iterable[Ground]) -> Iterator[str]:
    """Yield both tables, as the page has them."""
    yield "| Droplets fall | Shift [m] | of most [m] | Carry [m] | Left, corrected [m] |"
    yield "|---|---:|---:|---:|---:|"
    for row in shifts:
        yield (
            f"| {row.label} | {row.shift_m:.2f} | {row.low_m:.2f} to {row.high_m:.2f} "
            f"| {row.carry_m:.2f} | {row.left_m:.2f} |"
        )
    yield ""
    yield (
        "| Weather | Offset | Lag, abs [m] | Worst [m] | Misapplied [%] | Outside [mL] "
        "| Applied [mL] |"
    )
    yield "|---|---|---:|---:|---:|---:|---:|"
    for each in grounds:
        yield (
            f"| {each.label} | {'on' if each.corrected else 'off'} | {each.lag_mean_abs_m:.3f} "
            f"| {each.lag_worst_m:.3f} | {each.misapplied_percent:.2f} "
            f"| {each.off_target_ml:.1f} | {each.applied_ml:.0f} |"
        )


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m tools.studies.droplets --seeds 3")
def droplets(
    seeds: Annotated[int, typer.Option(min=0, max=100, help="Flights of seeds 1 to N.")] = 3,
    averaged: Annotated[
        bool, typer.Option("--averaged", help="The mean of the pulses instead of pulses.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Say where the deposit lands in wind, with and without the controller's offset."""
    shifts = [shift_of(truth) for truth in TRUTHS]
    grounds = [
        ground_of(
            weather,
            corrected=corrected,
            seeds=range(1, seeds + 1),
            fidelity="averaged" if averaged else "pulsed",
        )
        for weather in WEATHERS
        for corrected in (False, True)
        if seeds
    ]
    result = {"shifts": [asdict(row) for row in shifts], "flights": [asdict(g) for g in grounds]}
    answer(result, tables(shifts, grounds), as_json=as_json)


# Droplets as the twin has them: points with drag, from a moving nozzle through moving air.
#
# Independent of the controller's model (`companion/core/options/drift.py`): three dimensions
# instead of one, a spectrum instead of one size, slip of small droplets, wind that may fade to
# the ground. Evaporation, turbulence and the vortices beside the rotors are left out.

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
AIR_KG_M3 = 1.204
AIR_PA_S = 1.813e-5
AIR_FREE_PATH_M = 66e-9
WATER_KG_M3 = 998.0
# A flat fan's sheet leaves at about sqrt(2 p / rho) less its losses, at 2 to 3 bar.
EXIT_M_S = 15.0
# By volume; that of published models of flat fans.
SPECTRUM_SD = math.log(1.7)
STEP_S = 0.002
FALL_MAX_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """How the air moves. The wind is that at the height of the nozzle, (east, north), towards.

    With a `roughness_m` it fades to the ground as the logarithm of the height; without it is the
    same down to the ground. The downwash fades evenly to nothing there.
    """

    wind_east_m_s: float = 0.0
    wind_north_m_s: float = 0.0
    downwash_m_s: float = 8.0
    roughness_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Landing:
    """Where droplets land from where they were let go, one value a size, and how long it took."""

    east_m: Floats
    north_m: Floats
    time_s: Floats


def spectrum_um(median_um: float, classes: int = 9, spread: float = SPECTRUM_SD) -> Floats:
    """Return the middle sizes of classes of equal volume, log-normal about the median.

    >>> spectrum_um(250.0, classes=3).round().tolist()
    [150.0, 250.0, 418.0]
    """
    normal = NormalDist(math.log(median_um), spread)
    return np.array([math.exp(normal.inv_cdf((k + 0.5) / classes)) for k in range(classes)])


def fall(
    sizes_um: Floats, *, height_m: float, velocity_m_s: tuple[float, float], air: Air
) -> Landing:
    """Return where droplets of some sizes land, let go at `height_m` by a nozzle that moves.

    Runge and Kutta's fourth order; a step is a tenth of the relaxation time of the smallest size
    and at most `STEP_S`.
    """
    size_m = np.asarray(sizes_um, dtype=np.float64) * 1e-6
    if not (size_m.min() > 5e-6 and 0.0 < height_m <= 100.0):
        raise ValueError("droplets above 5 um and a height up to 100 m are wanted")
    relaxation_s = WATER_KG_M3 * size_m**2 / (18.0 * AIR_PA_S)
    step_s = min(STEP_S, 0.1 * float(relaxation_s.min()))
    # Rows: east, north, up; their velocities.
    now = np.zeros((6, len(size_m)))
    now[2] = height_m
    now[3], now[4], now[5] = velocity_m_s[0], velocity_m_s[1], -EXIT_M_S
    landed = np.full((3, len(size_m)), np.nan)
    for count in range(math.ceil(FALL_MAX_S / step_s)):
        before, now = now, _stepped(now, step_s, size_m, height_m, air)
        down = (now[2] <= 0.0) & np.isnan(landed[2])
        if down.any():
            share = before[2] / np.maximum(before[2] - now[2], 1e-12)
            landed[:2, down] = (before[:2] + share * (now[:2] - before[:2]))[:, down]
            landed[2, down] = ((count + share) * step_s)[down]
            if not np.isnan(landed[2]).any():
                break
    return Landing(east_m=landed[0], north_m=landed[1], time_s=landed[2])


def _stepped(now: Floats, step_s: float, size_m: Floats, height_m: float, air: Air) -> Floats:
    k1 = _change(now, size_m, height_m, air)
    k2 = _change(now + 0.5 * step_s * k1, size_m, height_m, air)
    k3 = _change(now + 0.5 * step_s * k2, size_m, height_m, air)
    k4 = _change(now + step_s * k3, size_m, height_m, air)
    after: Floats = now + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return after


def _change(now: Floats, size_m: Floats, height_m: float, air: Air) -> Floats:
    """Return velocities and accelerations: gravity and drag against the air around a droplet."""
    share = np.clip(now[2] / height_m, 0.0, 1.0)
    blows = _wind_share(now[2], height_m, air.roughness_m)
    against = np.array(
        [
            now[3] - air.wind_east_m_s * blows,
            now[4] - air.wind_north_m_s * blows,
            now[5] + air.downwash_m_s * share,
        ]
    )
    reynolds = AIR_KG_M3 * np.sqrt((against**2).sum(axis=0)) * size_m / AIR_PA_S
    # Stokes's drag with Cunningham's slip, and Schiller and Naumann's factor up to Re = 800.
    knudsen = 2.0 * AIR_FREE_PATH_M / size_m
    slip = 1.0 + knudsen * (1.257 + 0.4 * np.exp(-1.1 / knudsen))
    rate = 18.0 * AIR_PA_S / (WATER_KG_M3 * size_m**2 * slip) * (1.0 + 0.15 * reynolds**0.687)
    change = np.empty_like(now)
    change[:3] = now[3:]
    change[3:] = -rate * against
    change[5] -= GRAVITY_M_S2
    return change


def _wind_share(up_m: Floats, height_m: float, roughness_m: float) -> Floats:
    """Return the wind at a height over that at the nozzle."""
    if not roughness_m > 0.0:
        return np.ones_like(up_m)
    up = np.clip(up_m, roughness_m, height_m)
    share: Floats = np.log(up / roughness_m) / math.log(height_m / roughness_m)
    return share


if __name__ == "__main__":
    sys.exit(app())

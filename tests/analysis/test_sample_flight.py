"""Flights over real and made-up ragged maps: nothing outside, and what rate 0 allows."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely

from analysis.border import off_target_ml
from analysis.flight_record import Fidelity, FlightRecord
from analysis.strips import Strip, strips_of
from companion.config import load
from companion.core.setup import Setup
from companion.core.types import Decision
from missions.maps.compiling import compiled_setup
from sitl.flight import FlightOptions, FlightResult, fly
from sitl.fly import zero_rate_ml
from sitl.profile import PlantProfile, load_profile
from sitl.trajectory import Route
from sitl.vehicle import Vehicle
from tests.sitl.sample_route import SPEED_M_S, Line, along_edge, route_of, swaths

ORCHARD = Path(__file__).resolve().parents[2] / "examples" / "orchard"
SAMPLE = "01_shp_lha_multipolygon"
# Position noise across one change: two parts of 1.4 cm each.
POSITION_SD_M = 0.02
MAY_STAY_CLOSED_M = 1.0


@cache
def real_setup(samples: Path) -> Setup:
    """Return the sprayer of the orchard over the real map and its boundary."""
    folder = samples / SAMPLE
    config = load(
        ORCHARD / "config.toml",
        overrides=[
            f'prescription.file="{folder / "Rx.shp"}"',
            f'prescription.boundary="{folder / "boundary" / "Boundary.shp"}"',
        ],
    )
    return compiled_setup(config)


def fly_route(
    setup: Setup,
    route: Route,
    *,
    seed: int,
    fidelity: Fidelity = "averaged",
    decisions: list[Decision] | None = None,
) -> FlightResult:
    return fly(
        setup,
        Vehicle(route, start_s=0.0, seed=seed).fly_to_end(),
        load_profile("orchard-180"),
        FlightOptions(fidelity=fidelity, seed=seed),
        speed_m_s=SPEED_M_S,
        observer=None if decisions is None else decisions.append,
    )


def outline(setup: Setup) -> shapely.Polygon:
    part = shapely.get_parts(setup.prescription.field)[0]
    assert isinstance(part, shapely.Polygon)
    return part


def busy(setup: Setup) -> list[Line]:
    """Across the hole in the middle, where the zones are smallest, and once askew."""
    hole = shapely.Polygon(outline(setup).interiors[0]).centroid
    middle = (hole.x, hole.y)
    return [
        *swaths(middle, azimuth_deg=12.0, length_m=220.0, count=2),
        *swaths(middle, azimuth_deg=97.0, length_m=330.0, count=1),
        *swaths(middle, azimuth_deg=61.0, length_m=220.0, count=1),
    ]


def dry(setup: Setup) -> list[Line]:
    """Over the largest patch of rate 0, which touches the border, at two angles."""
    zero = shapely.union_all([z.polygon for z in setup.prescription.zones if z.rate_l_ha == 0.0])
    middle = max(shapely.get_parts(zero), key=lambda part: part.area).centroid
    return [
        line
        for azimuth_deg in (77.0, 20.0)
        for line in swaths((middle.x, middle.y), azimuth_deg=azimuth_deg, length_m=70.0, count=2)
    ]


def shallow(setup: Setup) -> list[Line]:
    """Along the border and along the hole at 5 degrees; the hole is 8 m wide at most there."""
    ends = list(outline(setup).exterior.coords)
    hole = list(outline(setup).interiors[0].coords)
    found = []
    for ring, angle_deg in ((ends, 5.0), (hole, -5.0)):
        sides = list(pairwise(ring))
        lengths = [np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in sides]
        a, b = sides[int(np.argsort(lengths)[len(lengths) // 2])]
        found.append(along_edge((a[0], a[1]), (b[0], b[1]), angle_deg))
    return found


ROUTES = {"busy": busy, "dry": dry, "shallow": shallow}


@cache
def flown(samples: Path, name: str, seed: int, fidelity: Fidelity) -> FlightRecord:
    """Fly a route over the real map; two tests ask of the same flight."""
    setup = real_setup(samples)
    return fly_route(setup, route_of(ROUTES[name](setup)), seed=seed, fidelity=fidelity).record


@pytest.mark.parametrize("name", ROUTES)
@pytest.mark.parametrize(("seed", "fidelity"), [(1, "averaged"), (2, "averaged"), (3, "pulsed")])
def test_nothing_falls_outside_the_border_and_in_holes_of_a_real_map(
    samples: Path, name: str, seed: int, fidelity: Fidelity
) -> None:
    record = flown(samples, name, seed, fidelity)
    strips = strips_of(record)
    assert off_target_ml(strips, real_setup(samples).prescription) == 0.0
    assert volume_ml(record) > 0.85 * asked_ml(strips)


def test_the_same_route_without_the_border_rule_sprays_outside(samples: Path) -> None:
    setup = replace(real_setup(samples), border="volume")
    record = fly_route(setup, route_of(shallow(setup)), seed=1).record
    assert off_target_ml(strips_of(record), setup.prescription) > 100.0


def test_what_falls_on_rate_0_of_a_real_map_is_what_the_step_allows(
    samples: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = Overspill.of(flown(samples, "dry", 1, "averaged"))
    with capsys.disabled():
        sys.stdout.write(f"\nreal map: {found}\n")
    assert found.zero_ml <= found.bound_ml


@pytest.mark.parametrize("fidelity", ["averaged", "pulsed"])
def test_what_falls_on_rate_0_of_the_orchard_is_what_the_step_allows(
    fidelity: Fidelity, capsys: pytest.CaptureFixture[str]
) -> None:
    found = Overspill.of(orchard_record(fidelity))
    with capsys.disabled():
        sys.stdout.write(f"\norchard, {fidelity}: {found}\n")
    assert found.changes >= 12
    assert found.zero_ml <= found.bound_ml


def test_the_bound_on_rate_0_is_broken_when_valves_close_too_late() -> None:
    found = Overspill.of(orchard_record("averaged", off_s=0.0))
    assert found.zero_ml > found.bound_ml


def orchard_record(fidelity: Fidelity, off_s: float | None = None) -> FlightRecord:
    """Fly passes along and across the strip and the patch of rate 0."""
    setup = compiled_setup(load(ORCHARD / "config.toml"))
    lag = setup.lag if off_s is None else replace(setup.lag, off_s=off_s)
    lines = [
        *swaths((12.0, 12.0), azimuth_deg=113.0, length_m=100.0, count=4, spacing_m=12.0),
        *swaths((-8.0, 21.0), azimuth_deg=70.0, length_m=60.0, count=2),
    ]
    return fly_route(replace(setup, lag=lag), route_of(lines), seed=1, fidelity=fidelity).record


def volume_ml(record: FlightRecord) -> float:
    return float((record.volume_ml[-1] - record.volume_ml[0]).sum())


def asked_ml(strips: list[Strip]) -> float:
    return float(sum(strip.asked_ml[-1] - strip.asked_ml[0] for strip in strips))


@dataclass(frozen=True)
class Overspill:
    """What fell on rate 0, and the bound of docs/howto/fly-in-simulation.md.

    bound = ideal + sum over changes of flow * (ramp / 8 + timing error). The ideal is what a
    sharp step on each boundary drops there: strips are as wide as they are.
    """

    zero_ml: float
    ideal_ml: float
    changes: int
    bound_ml: float

    @staticmethod
    def of(record: FlightRecord) -> Overspill:
        profile = load_profile("orchard-180")
        strips = strips_of(record)
        ideal = replace(record, volume_ml=np.column_stack([s.asked_ml for s in strips]))
        flows_ml_s = [flow for strip in strips for flow in _switched_ml_s(strip)]
        allowed_s = profile.ramp_s / 8.0 + _timing_sd_s(profile)
        ideal_ml = _zero_ml(ideal)
        return Overspill(
            zero_ml=_zero_ml(record),
            ideal_ml=ideal_ml,
            changes=len(flows_ml_s),
            bound_ml=ideal_ml + allowed_s * sum(flows_ml_s),
        )


def _zero_ml(record: FlightRecord) -> float:
    return zero_rate_ml(record, off_target_ml(strips_of(record), record.prescription))


def _switched_ml_s(strip: Strip) -> list[float]:
    """Return the flow of each change to or from rate 0 inside the field."""
    pairs = zip(strip.stretches[:-1], strip.stretches[1:], strict=True)
    return [
        max(a.rate_l_ha, b.rate_l_ha) * strip.track.width_m * SPEED_M_S * 0.1
        for a, b in pairs
        if a.inside and b.inside and (a.rate_l_ha > 0.0) != (b.rate_l_ha > 0.0)
    ]


def _timing_sd_s(profile: PlantProfile) -> float:
    """Return one standard deviation of a change's time: the valve's lag, and the position."""
    return float(np.hypot(profile.lag_scatter * profile.mean_lag_s, POSITION_SD_M / SPEED_M_S))


def test_valves_stay_closed_no_farther_than_a_metre_from_the_border(samples: Path) -> None:
    """Straight over the border: the margin is what lag, scatter and buffer take."""
    setup = real_setup(samples)
    a, b = outline(setup).exterior.coords[:2]
    line = along_edge((a[0], a[1]), (b[0], b[1]), 90.0)
    decisions: list[Decision] = []
    record = fly_route(setup, route_of([line]), seed=1, decisions=decisions).record
    strips = strips_of(record)
    lost_m2 = (asked_ml(strips) - volume_ml(record)) / 12.0
    assert not any(decision.late_count for decision in decisions)
    assert lost_m2 < 6.0 * 2 * MAY_STAY_CLOSED_M

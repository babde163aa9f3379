"""Beside a real PX4: its changes are held to what it tells; against the truth they are reported."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from tests.firmware.fields import HOME_DEG, pass_items, write_pass
from tests.firmware.firmware import companion
from tests.firmware.flights import (
    OFF_LINES_MAX_ML,
    PX4,
    check_simulated,
    fly_field,
    ready_px4,
    start,
    until_heard,
    until_landed,
)
from tests.firmware.judge import (
    Plane,
    Verdict,
    Zone,
    apart_m,
    geojson_area,
    geojson_zones,
    judge,
    judge_perfect,
    obeyed,
)
from tests.firmware.station import Log, MissionItem, Place

pytestmark = [pytest.mark.firmware, pytest.mark.timeout(300)]

MEAN_MAX_M, WORST_MAX_M, OFF_TARGET_MAX_ML = 0.05, 0.25, 0.1
# What is asked for is printed as met or missed; a flight fails by more than the bounds below. The
# place that PX4 tells goes by 2 to 3 % faster and slower than the velocity it tells, for seconds,
# and near a step of 17 % that moves the place where two doses meet: on 13 flights by 0.04 to 0.07 m
# on average and 0.34 m at most, were the changes on time to the millimetre and the dose by the
# velocity (`judge_perfect`). Apart from that ours were off by 0.030 to 0.070 m on average; at a
# step of 14 % a dose that is 1 % off for some metres makes 0.3 m. So each change is held to
# its metres of the greater dose: 0.030 to 0.045 m at most on 9 flights, and 0.06 m is 0.14 m at
# a step of 43 %. (docs/howto/connect-px4.md, what PX4 is off by)
OURS_MEAN_BOUND_M, OURS_DOSE_BOUND_M = 0.08, 0.06
MEAN_BOUND_M, WORST_BOUND_M, OFF_TARGET_BOUND_ML = 0.12, 0.45, 0.3
# So much (sd) is its place off sideways, and with it the column of zones that an outer valve is in.
GRAZING_M = 0.2
# The told place is the aim here. The example's `position_s` makes good what that is late by.
AS_TOLD = ("--set", "lag.position_s=0")
TOLD, PERFECT = "told", "told, a perfect sprayer"


def with_yaw_of(places: Sequence[Place], others: Sequence[Place]) -> list[Place]:
    """Return places with the headings of others, by when they came."""
    came_s = [one.came_s for one in others]
    yaw_rad = np.unwrap([one.yaw_rad for one in others])
    return [
        replace(place, yaw_rad=float(np.interp(place.came_s, came_s, yaw_rad))) for place in places
    ]


def estimate_errors(log: Log) -> str:
    """Return how far what PX4 tells is from the truth while it flies: along, aside, heading."""
    plane = Plane(*HOME_DEG)
    told_s = np.array([one.came_s for one in log.told])
    rows = {
        name: np.column_stack(
            [
                *plane.metres(
                    [one.longitude_deg for one in places], [one.latitude_deg for one in places]
                ),
                np.unwrap([one.yaw_rad for one in places]),
            ]
        )
        for name, places in (("told", log.told), ("true", log.places))
    }
    true_s = [one.came_s for one in log.places]
    true = np.column_stack([np.interp(told_s, true_s, rows["true"][:, n]) for n in range(3)])
    moves = np.gradient(true[:, :2], told_s, axis=0)
    speed = np.hypot(*moves.T)
    flies = speed > 3.0
    ahead = moves[flies] / speed[flies, None]
    off = (rows["told"] - true)[flies]
    along = (off[:, :2] * ahead).sum(axis=1)
    aside = off[:, 0] * ahead[:, 1] - off[:, 1] * ahead[:, 0]
    turned = np.degrees((off[:, 2] + np.pi) % (2.0 * np.pi) - np.pi)
    crab = np.degrees(true[flies, 2]) - np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    crab = (crab + 180.0) % 360.0 - 180.0
    parts = (
        ("along m", along),
        ("right m", aside),
        ("heading deg", turned),
        ("nose off course deg", crab),
    )
    return "told minus true: " + ", ".join(
        f"{name} {values.mean():+.3f} (sd {values.std():.3f}, "
        f"{values.min():+.2f} to {values.max():+.2f})"
        for name, values in parts
    )


def verdicts(
    log: Log,
    zones: Sequence[Zone],
    inside: shapely.Geometry,
    lines: Sequence[shapely.LineString] | None = None,
) -> dict[str, Verdict]:
    """Return what the flight did: by what PX4 tells, by the truth, and by one half of each.

    And what it would have done by what PX4 tells, had the sprayer no delay.

    Behind the outputs is the board that PX4 needs, one that closes what stands still.
    """
    pulses, _ = obeyed(log.pulses)
    ways = {
        TOLD: log.told,
        "told, true heading": with_yaw_of(log.told, log.places),
        "true, told heading": with_yaw_of(log.places, log.told),
        "true": log.places,
    }
    found = {
        name: judge(places, pulses, zones, inside=inside, lines=lines, grazing_m=GRAZING_M)
        for name, places in ways.items()
    }
    found[PERFECT] = judge_perfect(log.told, zones, inside=inside, lines=lines, grazing_m=GRAZING_M)
    return found


def fly_pass(
    firmwares: Path,
    folder: Path,
    items: Sequence[MissionItem],
    tell: Callable[[object], None],
) -> dict[str, Verdict]:
    """Fly passes over eight zones and judge them in four ways."""
    config = write_pass(folder / "field", config="px4.toml")
    with ready_px4(folder / "px4", firmwares) as vehicle:
        with companion(folder, "--config", str(config), *PX4.options, *AS_TOLD) as started:
            until_heard(vehicle.station, started, folder / "companion.txt")
            vehicle.station.log.clear_flight()
            start(vehicle, items)
            until_landed(vehicle, 150.0)
        log = vehicle.station.log
        (folder / "log.pkl").write_bytes(pickle.dumps((log.places, log.pulses, log.told)))
    check_simulated(config.parent)
    zones = geojson_zones(config.parent / "zones.geojson")
    return told_of(
        log, verdicts(log, zones, geojson_area(config.parent / "boundary.geojson")), tell
    )


def told_of(
    log: Log, found: dict[str, Verdict], tell: Callable[[object], None]
) -> dict[str, Verdict]:
    """Tell what was found, and return it; the board must not have closed in the middle."""
    tell(estimate_errors(log))
    for name, verdict in found.items():
        tell(f"{name}: {verdict}")
    _, closings = obeyed(log.pulses)
    assert not closings
    return found


def holds(found: dict[str, Verdict], tell: Callable[[object], None]) -> Verdict:
    """Hold a flight to what PX4 tells, and say whether it did what is asked for."""
    told = found[TOLD]
    is_met = told.mean_abs_m <= MEAN_MAX_M and told.worst_m <= WORST_MAX_M
    is_met = is_met and told.off_target_ml <= OFF_TARGET_MAX_ML
    bars = f"mean {MEAN_MAX_M} m, worst {WORST_MAX_M} m, off target {OFF_TARGET_MAX_ML} mL"
    tell(f"{bars}: {'met' if is_met else 'MISSED'}")
    ours_m, dose_m = apart_m(told, found[PERFECT])
    mean_m, worst_m = np.abs(ours_m).mean(), np.abs(ours_m).max()
    tell(
        f"ours of it: mean {mean_m:.3f} m (signed {ours_m.mean():+.3f}), worst {worst_m:.3f} m, "
        f"{dose_m.max():.3f} m of the greater dose"
    )
    assert not told.missed
    assert len(ours_m) == len(told.changes)
    assert mean_m <= OURS_MEAN_BOUND_M
    assert dose_m.max() <= OURS_DOSE_BOUND_M
    assert told.mean_abs_m <= MEAN_BOUND_M
    assert told.worst_m <= WORST_BOUND_M
    assert told.off_target_ml <= OFF_TARGET_BOUND_ML
    return told


@pytest.mark.short
def test_each_change_falls_where_px4_believes_its_boundary(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    found = fly_pass(firmwares, tmp_path, pass_items(5.0), tell)
    told = holds(found, tell)
    assert len(told.changes) == 7 * 6


def test_two_passes_are_held_to_what_it_tells(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    found = fly_pass(firmwares, tmp_path, pass_items(5.0, passes=2), tell)
    holds(found, tell)


def test_the_planned_and_uploaded_field_is_sprayed_on_its_lines(
    firmwares: Path, tmp_path: Path, tell: Callable[[object], None]
) -> None:
    flown = fly_field(PX4, firmwares, tmp_path, *AS_TOLD)
    log = flown.log
    found = told_of(log, verdicts(log, flown.zones, flown.inside, flown.lines), tell)
    told = holds(found, tell)
    assert len(told.changes) >= 190  # of 216; those of valves along a boundary count apart
    assert told.off_lines_ml <= OFF_LINES_MAX_ML
    assert told.sprayed_l == pytest.approx(flown.planned_l, rel=0.05)

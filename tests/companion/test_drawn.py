"""A place that is drawn after GNSS, beside the velocity that is told: recorded and made up."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.core.estimator import Motion, begun
from companion.core.estimator import followed as moved_on
from companion.core.frame import LocalFrame
from companion.core.motion import (
    AGREES_M_S,
    DRAWN_MAX_M_S,
    MEMORY_S,
    NOT_DRAWN,
    QUICK_TIME_S,
    SLOW_TIME_S,
    Drawn,
    followed,
)
from companion.core.types import Telemetry
from tests.builders import position

Floats = NDArray[np.float64]

RECORDED = Path(__file__).parents[1] / "data" / "told"
COURSE = math.radians(12.0)
# From an order to the middle of what it does at the nozzles: half a servo frame, dead time, half
# of the rise.
ACTS_S = 0.010 + 0.069 + 0.035
GRID_S = 0.01
DT_S = 0.05


def recorded(name: str) -> list[Telemetry]:
    """Return the positions of a pass as they were told."""
    rows = np.loadtxt(RECORDED / f"{name}.csv", delimiter=",", skiprows=2)
    told = position(0.0, 0.0, 0.0)
    return [
        replace(
            told,
            received_s=boot_ms * 1e-3,
            boot_s=boot_ms * 1e-3,
            latitude_deg=lat * 1e-7,
            longitude_deg=lon * 1e-7,
            velocity_north_m_s=vx * 1e-2,
            velocity_east_m_s=vy * 1e-2,
        )
        for boot_ms, lat, lon, vx, vy in rows.tolist()
    ]


def followed_all(items: list[Telemetry]) -> tuple[list[Motion], Floats]:
    """Return the motion after each position, and how far along the track each of them is."""
    frame = LocalFrame(items[0].latitude_deg, items[0].longitude_deg)
    motions: list[Motion] = []
    along_m = []
    for item in items:
        place = frame.to_local(item.latitude_deg, item.longitude_deg)
        along_m.append(along(*place))
        motions.append(
            moved_on(motions[-1], item, place, item.boot_s)
            if motions
            else begun(item, place, item.boot_s)
        )
    return motions, np.array(along_m)


def along(east: float, north: float) -> float:
    return east * math.sin(COURSE) + north * math.cos(COURSE)


def smooth(values: Floats) -> Floats:
    """Fit a parabola over 0.1 s to each side of each point of the grid."""
    half = round(0.1 / GRID_S)
    away = np.arange(-half, half + 1.0)
    kernel = (away**4).sum() - (away**2).sum() * away**2
    found: Floats = np.convolve(values - values[0], kernel / kernel.sum(), mode="same") + values[0]
    return found


def lag_distances_m(items: list[Telemetry]) -> tuple[Floats, Floats]:
    """Return where a step from 20 to 24 L/ha would fall, were it anywhere along the pass.

    By our velocities and by the told ones alone. The step is on time; what is off is the dose.
    """
    motions, along_m = followed_all(items)
    at_s = np.array([item.boot_s for item in items])
    grid_s = np.arange(at_s[0], at_s[-1], GRID_S)
    place_m = smooth(np.interp(grid_s, at_s, along_m))
    ours, alone = [], []
    for motion in motions:
        east, north = motion.after(0.0)
        ours.append(along(east.velocity_m_s, north.velocity_m_s))
        seen = [one.velocity_m_s or 0.0 for one in motion.seen]
        alone.append(along(seen[0], seen[1]))
    flies = np.flatnonzero(np.interp(grid_s, at_s, ours) > 4.0)
    marks = grid_s[flies[0]] + 1.0, grid_s[flies[-1]] - 1.0
    centres_m = np.arange(*np.interp(marks, grid_s, place_m), 0.25)
    found = []
    for speeds in (ours, alone):
        held = np.searchsorted(at_s, grid_s - ACTS_S, side="right") - 1
        ahead_m = np.cumsum(np.array(speeds)[np.clip(held, 0, None)]) * GRID_S - place_m
        far, near, here, on, on_far = (
            np.interp(centres_m + away_m, np.maximum.accumulate(place_m), ahead_m)
            for away_m in (-4.0, -1.0, 0.0, 1.0, 4.0)
        )
        before, after = here - near - (near - far) / 3.0, on - here - (on_far - on) / 3.0
        found.append((20.0 * before + 24.0 * after) / (20.0 - 24.0))
    return found[0], found[1]


def test_the_dose_goes_with_the_place_that_px4_tells() -> None:
    ours_m, alone_m = lag_distances_m(recorded("px4_pass"))
    assert np.abs(alone_m).mean() > 0.08
    assert np.abs(ours_m).mean() < 0.8 * np.abs(alone_m).mean()
    assert np.abs(ours_m).max() < 0.25 < np.abs(alone_m).max()


def test_nothing_is_added_to_a_velocity_that_goes_with_its_place() -> None:
    """ArduCopter's do: what its quick mean shows is its place rounded to 1 cm."""
    items = recorded("arducopter_pass")
    motions, _ = followed_all(items)
    for motion in motions:
        assert [by.after(0.0) for by in motion.drawn] == [0.0, 0.0]
    ours_m, alone_m = lag_distances_m(items)
    assert np.abs(ours_m).mean() < 1.1 * np.abs(alone_m).mean() < 0.03


# --------------------------------------------------------------------------------- made up


def drawn_by(outruns_m_s: list[float]) -> Drawn:
    by = NOT_DRAWN
    for outrun_m_s in outruns_m_s:
        by = followed(by, DT_S, (5.0 + outrun_m_s) * DT_S, 5.0)
    return by


DISAGREED = [0.3, -0.3] * 3 + [0.3] * 20 + [-0.3] * 20


def test_what_has_just_begun_is_followed_and_what_stays_is_not() -> None:
    begun_by = drawn_by(DISAGREED + [0.0] * 40 + [0.2] * 2)
    assert 0.05 < begun_by.after(0.0) < 0.2
    assert drawn_by(DISAGREED + [0.2] * 60).after(0.0) == pytest.approx(0.0, abs=1e-3)


def test_it_fades_while_no_position_comes() -> None:
    by = drawn_by(DISAGREED + [0.2] * 2)
    assert by.after(SLOW_TIME_S) == pytest.approx(by.after(0.0) / math.e)
    assert by.after(-1.0) == by.after(0.0)
    assert abs(by.after(2.0)) < 1e-4


def test_the_means_forget_with_their_times() -> None:
    by = followed(Drawn(0.3, 0.2, 0.04), DT_S, 5.0 * DT_S, 5.0)
    slow_m_s = 0.2 * math.exp(-DT_S / SLOW_TIME_S)
    assert by.quick_m_s == pytest.approx(0.3 * math.exp(-DT_S / QUICK_TIME_S))
    assert by.slow_m_s == pytest.approx(slow_m_s)
    kept = math.exp(-DT_S / MEMORY_S)
    assert by.square_m2_s2 == pytest.approx(kept * 0.04 + (1.0 - kept) * slow_m_s**2)


def test_a_disagreement_counts_as_far_as_it_is_larger_than_rounding() -> None:
    square = AGREES_M_S * AGREES_M_S
    assert Drawn(0.2, 0.1, square).after(0.0) == 0.0
    assert Drawn(0.2, 0.1, 4.0 * square).after(0.0) == pytest.approx(0.075)
    assert Drawn(0.1, 0.2, 4.0 * square).after(0.0) == pytest.approx(-0.075)


@pytest.mark.parametrize("jump_m", [2.0, -0.2, math.nan, math.inf])
def test_a_place_that_is_set_anew_is_not_driven_to(jump_m: float) -> None:
    before = drawn_by(DISAGREED)
    by = followed(before, DT_S, 5.0 * DT_S + jump_m, 5.0)
    assert by == Drawn(square_m2_s2=before.square_m2_s2)
    assert by.after(0.0) == 0.0


@pytest.mark.parametrize("dt_s", [0.02, 0.05, 0.2])
def test_the_largest_drawing_is_no_jump(dt_s: float) -> None:
    gone_m = (5.0 + DRAWN_MAX_M_S) * dt_s
    assert followed(NOT_DRAWN, dt_s, gone_m, 5.0).quick_m_s > 0.0


def test_only_a_velocity_that_is_doubted_is_added_to() -> None:
    item = position(0.0, 0.0, 0.0)
    motion = begun(item, (0.0, 0.0), item.boot_s)
    by = Drawn(0.2, 0.1, 1.0)
    for doubt_share in (0.0, 0.5, 1.0):
        one = motion._replace(drawn=(by, NOT_DRAWN), doubt_share=doubt_share)
        east, north = one.after(0.0)
        plain, _ = motion.after(0.0)
        added_m_s = east.velocity_m_s - plain.velocity_m_s
        assert added_m_s == pytest.approx(doubt_share * by.after(0.0))
        assert east.position_m == plain.position_m
        assert north == motion.after(0.0)[1]


def test_without_a_told_velocity_nothing_is_drawn() -> None:
    item = position(0.0, 0.0, 0.0)
    before = begun(item, (0.0, 0.0), 0.0)._replace(drawn=(Drawn(0.2, 0.1, 1.0),) * 2)
    dumb = replace(item, boot_s=DT_S, velocity_east_m_s=None, velocity_north_m_s=None)
    motion = moved_on(before, dumb, (0.0, 0.0), DT_S)
    assert motion.drawn == (NOT_DRAWN, NOT_DRAWN)
    after = moved_on(motion, replace(item, boot_s=2 * DT_S), (0.0, 0.0), 2 * DT_S)
    assert after.drawn == (NOT_DRAWN, NOT_DRAWN)

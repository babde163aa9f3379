"""Buffers of no-spray areas that are wider downwind, and swaths measured by height and speed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box

from companion.config import load
from missions.errors import PlanError
from missions.field import WindBuffer, build_field
from missions.reading_ground import SwathPoint, swath_width_m
from tests.bench.missions import FRAME, to_degrees
from tests.missions.test_missions_cli import ANYANG, run, written

L_SHAPE = Polygon([(0, 0), (40, 0), (40, 10), (15, 10), (15, 50), (0, 50)])


@settings(max_examples=30)
@given(
    speed_m_s=st.floats(0.0, 8.0),
    from_deg=st.floats(0.0, 360.0),
    base_m=st.floats(0.0, 10.0),
    m_per_m_s=st.floats(0.0, 6.0),
    seed=st.integers(0, 10_000),
)
def test_no_place_outside_is_nearer_than_its_buffer(
    speed_m_s: float, from_deg: float, base_m: float, m_per_m_s: float, seed: int
) -> None:
    wind = WindBuffer(speed_m_s=speed_m_s, from_deg=from_deg, m_per_m_s=m_per_m_s)
    ground = wind.around(L_SHAPE, base_m)
    shapely.prepare(ground)
    draw = np.random.default_rng(seed)
    for east_m, north_m in draw.uniform(-70.0, 110.0, (20, 2)).tolist():
        place = shapely.Point(east_m, north_m)
        if ground.covers(place):
            continue
        near = shapely.get_coordinates(shapely.shortest_line(place, L_SHAPE))[1]
        towards = math.degrees(math.atan2(near[0] - east_m, near[1] - north_m))
        # The buffer around the area is of chords: base_m is rounded inwards by GEOS' circles.
        assert place.distance(L_SHAPE) >= wind.width_m(towards, base_m) - 0.01 * base_m - 1e-6


@settings(max_examples=30)
@given(from_deg=st.floats(0.0, 360.0), extra_m=st.floats(0.5, 40.0))
def test_a_buffer_is_hardly_wider_than_its_formula(from_deg: float, extra_m: float) -> None:
    wind = WindBuffer(speed_m_s=1.0, from_deg=from_deg, m_per_m_s=extra_m)
    point = box(0.0, 0.0, 1e-6, 1e-6)
    for east_m, north_m in shapely.get_coordinates(wind.around(point, 3.0)).tolist():
        towards = math.degrees(math.atan2(-east_m, -north_m))
        assert math.hypot(east_m, north_m) <= 1.003 * wind.width_m(towards, 3.0) + 1e-3


def test_without_wind_the_buffer_is_the_plain_one() -> None:
    calm = WindBuffer(speed_m_s=0.0, from_deg=77.0, m_per_m_s=5.0)
    assert calm.around(L_SHAPE, 4.0).equals(L_SHAPE.buffer(4.0))


def test_holes_of_an_area_get_the_buffer_too() -> None:
    ring = box(0, 0, 100, 100).difference(box(20, 20, 80, 80))
    ground = WindBuffer(speed_m_s=4.0, from_deg=270.0, m_per_m_s=5.0).around(ring, 2.0)
    # Wind from the west: inside, the eastern rim is downwind of the free ground.
    assert not ground.covers(shapely.Point(30.0, 50.0))
    assert ground.covers(shapely.Point(65.0, 50.0))
    assert not ground.covers(shapely.Point(55.0, 50.0))


def test_a_neighbour_downwind_keeps_more_of_the_field_dry() -> None:
    neighbour = to_degrees(box(200.0, 0.0, 260.0, 100.0))

    def sprayed(from_deg: float) -> tuple[float, float, float, float]:
        wind = WindBuffer(speed_m_s=3.0, from_deg=from_deg, m_per_m_s=5.0)
        field = build_field(
            to_degrees(box(0.0, 0.0, 200.0, 100.0)), no_spray=[neighbour],
            no_spray_buffer_m=5.0, wind=wind, swath_width_m=6.0, frame=FRAME,
        )  # fmt: skip
        bounds: tuple[float, float, float, float] = field.spray.bounds
        return bounds

    # A buffer that has a bend is drawn with fewer corners: larger by 0.1 m at most.
    assert 179.9 <= sprayed(270.0)[2] <= 180.0
    assert 194.85 <= sprayed(90.0)[2] <= 195.0
    assert 194.8 <= sprayed(0.0)[2] <= 195.0


def config_with(tmp_path: Path, lines: str) -> Path:
    """Write the example's configuration with more keys of [mission]."""
    text = (ANYANG / "config.toml").read_text()
    path = tmp_path / "config.toml"
    path.write_text(text.replace("[mission]\n", f"[mission]\n{lines}\n"))
    for file in ANYANG.iterdir():
        if file.is_file() and file.name != "config.toml":
            (tmp_path / file.name).write_bytes(file.read_bytes())
    return path


@pytest.mark.usefixtures("searched_briefly")
def test_the_wind_of_the_command_widens_the_configured_buffers(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 200, 100), tmp_path / "f.geojson")
    garden = written(box(200, 0, 260, 100), tmp_path / "g.geojson")
    config = config_with(tmp_path, "wind_buffer_m_per_m_s = 5.0\nno_spray_buffer_m = 5.0")
    words = [field, "--config", config, "--no-spray", garden, "--rate-l-ha", "20",
             "--out", tmp_path / "m.plan"]  # fmt: skip
    areas = []
    for more in ([], ["--wind", "3,270"], ["--wind", "3,90"], ["--no-spray-buffer-m", "20"]):
        code, found, _ = run(capsys, *words, *more)
        assert code == 0
        areas.append(found["area_ha"])
    assert areas == pytest.approx([1.95, 1.80, 1.95, 1.80], abs=0.002)


@pytest.mark.parametrize(
    ("keys", "more", "says"),
    [
        ("", ["--wind", "3,270"], "mission.wind_buffer_m_per_m_s"),
        ("wind = [3.0, 270.0]", [], "mission.wind_buffer_m_per_m_s"),
        ("wind_buffer_m_per_m_s = 5.0", ["--wind", "west"], "SPEED,FROM"),
        ("wind_buffer_m_per_m_s = 5.0", ["--wind", "nan,270"], "--wind"),
        ("wind_buffer_m_per_m_s = 5.0", ["--wind", "3,inf"], "--wind"),
    ],
)
def test_a_wind_that_says_too_little_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, keys: str, more: list[str], says: str
) -> None:
    config = config_with(tmp_path, keys)
    code, found, err = run(
        capsys, tmp_path / "boundary.geojson", "--config", config, *more,
        "--no-spray", tmp_path / "boundary.geojson", "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert says in found["error"]
    assert not (tmp_path / "m.plan").exists()


TABLE = [
    SwathPoint(height_m=h, speed_m_s=v, width_m=w)
    for h, v, w in ((2.0, 4.0, 5.0), (2.0, 8.0, 6.0), (4.0, 4.0, 6.0), (4.0, 8.0, 8.0))
]


@given(height_m=st.floats(2.0, 4.0), speed_m_s=st.floats(4.0, 8.0))
def test_a_swath_lies_between_its_measurements(height_m: float, speed_m_s: float) -> None:
    width_m = swath_width_m(TABLE, height_m=height_m, speed_m_s=speed_m_s)
    up, fast = (height_m - 2.0) / 2.0, (speed_m_s - 4.0) / 4.0
    assert width_m == pytest.approx(5.0 + up + fast + up * fast)


@pytest.mark.parametrize(
    ("table", "height_m", "speed_m_s", "says"),
    [
        (TABLE, 4.5, 6.0, "mission.height_m = 4.5 lies outside"),
        (TABLE, 3.0, 3.9, "mission.speed_m_s = 3.9 lies outside"),
        (TABLE, math.nan, 6.0, "mission.height_m"),
        (TABLE[:3], 3.0, 6.0, "no width at 4 m and 8 m/s"),
        ([*TABLE, TABLE[0]], 3.0, 6.0, "two widths"),
    ],
)
def test_no_swath_is_made_up(
    table: list[SwathPoint], height_m: float, speed_m_s: float, says: str
) -> None:
    with pytest.raises(PlanError, match=says):
        swath_width_m(table, height_m=height_m, speed_m_s=speed_m_s)


def swath_tables(widths: tuple[float, float]) -> str:
    rows = [
        f"[[mission.swath]]\nheight_m = {height}\nspeed_m_s = {speed}\nwidth_m = {width}\n"
        for height in (3.0, 4.0)
        for speed, width in zip((4.0, 6.0), widths, strict=True)
    ]
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("widths", "more", "code"),
    [((5.9, 6.1), [], 0), ((5.9, 6.1), ["--speed-m-s", "7"], 2), ((5.0, 6.0), [], 2)],
)
def test_passes_are_spaced_by_the_measured_swath(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, widths: tuple[float, float],
    more: list[str], code: int,
) -> None:  # fmt: skip
    config = config_with(tmp_path, "")
    config.write_text(config.read_text() + "\n" + swath_tables(widths))
    assert len(load(config).mission.swath) == 4  # type: ignore[union-attr]
    found_code, found, _ = run(
        capsys, tmp_path / "boundary.geojson", "--config", config, "--rate-l-ha", "20", *more,
        "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert found_code == code
    if code:
        assert "mission.swath" in found["error"]
    else:
        # 25 m by 120 m in passes of 6.0 m, a little over four of them.
        assert found["swaths"] == 5

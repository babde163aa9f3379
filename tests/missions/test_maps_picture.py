"""The picture of a map: every place has the colour that the legend gives to its rate."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import shapely
from matplotlib.image import imread
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon, box

from companion.core.frame import metres_per_degree
from companion.errors import MapError
from companion.map_pictures import scale_length_m
from missions.maps.build import frame_for
from missions.maps.model import MapCells, MapFile, MapZone
from missions.maps.picture import DPI, _bounds_m, draw, printable, sheet_for
from missions.maps.picture_ground import Colours
from missions.maps.totals import as_sprayed

LON, LAT = 8.73, 47.42
ACROSS_M, ALONG_M = metres_per_degree(LAT)
NAN = math.nan


def ground(area: Polygon | MultiPolygon) -> Polygon | MultiPolygon:
    scale, origin = np.array([ACROSS_M, ALONG_M]), np.array([LON, LAT])
    return shapely.transform(area, lambda points: points / scale + origin)


def a_map(
    zones: Sequence[tuple[Polygon | MultiPolygon, float | None]] = (),
    *,
    cells: object = None,
    boundary: MultiPolygon | None = None,
    default_l_ha: float | None = None,
) -> MapFile:
    grid = None
    if cells is not None:
        rates = np.array(cells, dtype=np.float64)
        transform = (10 / ACROSS_M, 0.0, LON, 0.0, -10 / ALONG_M, LAT + len(rates) * 10 / ALONG_M)
        grid = MapCells(rates_l_ha=rates, transform=transform, crs=CRS.from_epsg(4326))
    return MapFile(
        path=Path("field.shp"),
        format="",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate",
        zones=tuple(
            MapZone(name=f"$z{index}_{{", geometry=ground(area), rate_l_ha=rate)
            for index, (area, rate) in enumerate(zones)
        ),
        sha256="",
        cells=grid,
        boundary=None if boundary is None else MultiPolygon(shapely.get_parts(ground(boundary))),
        default_rate_l_ha=default_l_ha,
    )


class Picture:
    """A drawn map, asked for the colour at metres from the origin of its degrees."""

    def __init__(self, map_file: MapFile, path: Path) -> None:
        draw(map_file, path, title="field")
        self.pixels: NDArray[np.float64] = imread(BytesIO(path.read_bytes()), format="png")
        sprayed = as_sprayed(map_file)
        self._frame = frame_for(sprayed)
        self._sheet = sheet_for(_bounds_m(sprayed, self._frame))

    def at(self, east_m: float, north_m: float) -> tuple[float, ...]:
        east, north = self._frame.to_local(LAT + north_m / ALONG_M, LON + east_m / ACROSS_M)
        west, south, _, _ = self._sheet.ground_m
        scale = self._sheet.metres_per_inch
        x = int(DPI * (0.4 + (east - west) / scale))
        y = int(DPI * (self._sheet.size_in[1] - 0.9 - (north - south) / scale))
        return tuple(np.round(self.pixels[y, x, :3].astype(np.float64), 2).tolist())


def colour(rates: Sequence[float], rate: float) -> tuple[float, ...]:
    """Return the colour of a rate among all rates of a map, as a picture has it."""
    shade = Colours.of(np.array(rates))(np.array([rate]))[0, :3]
    return tuple(np.round(np.rint(shade * 255) / 255, 2).tolist())


WHITE = (1.0, 1.0, 1.0)
HOLED = box(0, 0, 100, 60).difference(box(20, 20, 40, 40))


@pytest.mark.parametrize(
    "holed", [HOLED, Polygon(HOLED.exterior, [HOLED.interiors[0].reverse()]), HOLED.reverse()]
)
def test_zones_have_the_colours_of_their_rates_and_holes_none(
    tmp_path: Path, holed: Polygon
) -> None:
    picture = Picture(
        a_map([(holed, 20.0), (box(100, 0, 150, 60), 35.5), (box(150, 0, 180, 60), 0.0)]),
        tmp_path / "map.png",
    )
    rates = [0.0, 20.0, 35.5]
    assert picture.at(10, 10) == colour(rates, 20.0)
    assert picture.at(30, 30) == WHITE
    assert picture.at(110, 10) == colour(rates, 35.5)
    assert picture.at(155, 10) == WHITE
    assert len({colour(rates, rate) for rate in rates}) == 3


def test_rates_are_labelled_where_there_is_room(tmp_path: Path) -> None:
    def middle_has_text(width_m: float) -> bool:
        picture = Picture(
            a_map([(box(0, 0, 400, 300), 20.0), (box(400, 0, 400 + width_m, 300), 30.0)]),
            tmp_path / "map.png",
        )
        found = {picture.at(400 + width_m / 2 + east / 2, 150) for east in range(-4, 5)}
        return len(found - {colour([20.0, 30.0], 30.0)}) > 0

    assert middle_has_text(150.0)
    assert not middle_has_text(6.0)


def test_a_later_zone_lies_on_top_and_one_without_a_rate_beneath(tmp_path: Path) -> None:
    picture = Picture(
        a_map([(box(0, 0, 60, 60), 10.0), (box(30, 0, 90, 60), 20.0), (box(0, 0, 120, 60), None)]),
        tmp_path / "map.png",
    )
    assert picture.at(10, 10) == colour([10.0, 20.0], 10.0)
    assert picture.at(45, 10) == colour([10.0, 20.0], 20.0)
    hatched = {picture.at(100 + east / 4, 20) for east in range(40)}
    assert (0.95, 0.95, 0.95) in hatched
    assert len(hatched) > 1


def test_cells_lie_where_they_are(tmp_path: Path) -> None:
    rates = [[10.0, 20.0, NAN], [0.0, 10.0, 20.0]]
    picture = Picture(a_map(cells=rates), tmp_path / "map.png")
    listed = [0.0, 10.0, 20.0]
    assert picture.at(2, 12) == colour(listed, 10.0)
    assert picture.at(12, 12) == colour(listed, 20.0)
    assert picture.at(25, 15) == WHITE
    assert picture.at(2, 2) == WHITE
    assert picture.at(12, 2) == colour(listed, 10.0)
    assert picture.at(28, 8) == colour(listed, 20.0)
    # A cell of rate 0 has a line around it, ground without a rate has none.
    assert min(picture.at(5, north / 100)[0] for north in range(-9, 10)) < 0.9
    assert {picture.at(25 + east, 19.5) for east in range(4)} == {WHITE}


def test_many_rates_are_a_scale_with_the_largest_darkest(tmp_path: Path) -> None:
    rates = np.linspace(5.0, 60.0, 20).reshape(4, 5)
    picture = Picture(a_map(cells=rates), tmp_path / "map.png")
    assert picture.at(5, 35) == colour(rates.ravel().tolist(), 5.0)
    assert picture.at(45, 5) == colour(rates.ravel().tolist(), 60.0)
    light = [sum(colour(rates.ravel().tolist(), rate)) for rate in rates.ravel().tolist()]
    assert light == sorted(light, reverse=True)


def test_default_and_boundary_are_drawn_as_they_would_be_sprayed(tmp_path: Path) -> None:
    field = MultiPolygon([box(0, 0, 100, 60)])
    source = a_map([(box(60, 0, 140, 60), 30.0)], boundary=field, default_l_ha=12.0)
    picture = Picture(source, tmp_path / "map.png")
    assert picture.at(30, 50) == colour([12.0, 30.0], 12.0)
    assert picture.at(80, 50) == colour([12.0, 30.0], 30.0)
    bare = Picture(a_map([(box(60, 0, 99, 60), 30.0)], boundary=field), tmp_path / "bare.png")
    assert (0.95, 0.95, 0.95) in {bare.at(20 + east / 2, 30) for east in range(20)}


@pytest.mark.parametrize(
    "bounds", [(0, 0, 1500, 90), (0, 0, 80, 2000), (0, 0, 600, 500), (0, 0, 0.1, 0.1)]
)
def test_a_sheet_is_readable_whatever_the_field(bounds: tuple[float, ...]) -> None:
    sheet = sheet_for((bounds[0], bounds[1], bounds[2], bounds[3]))
    wide, high = sheet.size_in
    assert 9.0 <= wide <= 16.0
    assert 6.0 <= high <= 12.0
    west, south, east, north = sheet.ground_m
    assert west < bounds[0] < bounds[2] < east
    assert south < bounds[1] < bounds[3] < north
    assert (east - west) / (north - south) == pytest.approx(sheet.map_in[0] / sheet.map_in[1])


@pytest.mark.parametrize("width_m", [0.9, 7.0, 99.0, 1234.0, 20_000.0])
def test_the_scale_is_a_round_length_of_use(width_m: float) -> None:
    length = scale_length_m(width_m)
    assert width_m / 10.0 <= length <= width_m / 4.0
    assert f"{length:e}"[0] in "125"


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_same_map_makes_the_same_file(tmp_path: Path, suffix: str) -> None:
    source = a_map([(HOLED, 20.0)], boundary=MultiPolygon([box(-5, -5, 105, 65)]))
    for name in ("one", "two"):
        draw(source, tmp_path / f"{name}{suffix}", title="t")
    one, two = sorted(tmp_path.iterdir())
    assert one.read_bytes() == two.read_bytes()
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF-"}[suffix]
    assert one.read_bytes().startswith(start)


@pytest.mark.parametrize("title", ["处方图.shp", "a$b_{2}^", "x" * 500, "", "a\tb\x07"])
def test_any_title_is_drawn_without_a_warning(tmp_path: Path, title: str) -> None:
    draw(a_map([(HOLED, 20.0)]), tmp_path / "map.png", title=title)
    assert (tmp_path / "map.png").stat().st_size > 5000


def test_letters_that_the_font_lacks_are_named_by_number() -> None:
    assert printable("Süd 处") == "Süd \\u5904"
    assert printable("a\nb") == "a\\nb"


@pytest.mark.parametrize("rate", [0.0, None, 20.0])
def test_a_map_of_one_kind_is_drawn(tmp_path: Path, rate: float | None) -> None:
    found = draw(a_map([(HOLED, rate)]), tmp_path / "map.png", title="t")
    assert found.rates_l_ha.tolist() == ([] if rate is None else [rate])


def test_the_totals_are_those_of_the_legend(tmp_path: Path) -> None:
    found = draw(a_map([(box(0, 0, 100, 50), 20.0)]), tmp_path / "map.png", title="t")
    assert found.area_ha == pytest.approx(0.5, rel=1e-4)
    assert found.all_litres == pytest.approx(10.0, rel=1e-4)


def test_other_kinds_of_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"\.png, \.svg, \.pdf") as caught:
        draw(a_map([(HOLED, 20.0)]), tmp_path / "map.jpeg", title="t")
    assert caught.value.code == "unknown-format"
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(MapError, match=r"pip install 'vrspray\[office\]'") as caught:
        draw(a_map([(HOLED, 20.0)]), tmp_path / "map.png", title="t")
    assert caught.value.code == "missing-library"


def test_a_folder_that_is_not_there_is_an_error_and_no_traceback(tmp_path: Path) -> None:
    with pytest.raises(MapError) as caught:
        draw(a_map([(HOLED, 20.0)]), tmp_path / "none" / "map.png", title="t")
    assert caught.value.code == "not-written"

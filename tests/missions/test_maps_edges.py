"""Maps that are no map: pipes, poles, the date line, empty tables, columns without a number."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS

from companion.cli.app import execute
from companion.errors import MapError
from missions.maps.cells import check_place
from missions.maps.model import MapCells
from missions.maps.registry import read_map

Captured = pytest.CaptureFixture[str]


def zones(path: Path, boxes: list[tuple[float, float, float, float]], **columns: Any) -> Path:
    """Write one feature a box (west, south, east, north), with the properties of that row."""
    features = [
        {
            "type": "Feature",
            "properties": {name: values[row] for name, values in columns.items()},
            "geometry": {
                "type": "Polygon",
                "coordinates": [[[w, s], [e, s], [e, n], [w, n], [w, s]]],
            },
        }
        for row, (w, s, e, n) in enumerate(boxes)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def refused(path: Path, **reading: Any) -> MapError:
    with pytest.raises(MapError) as caught:
        read_map(path, **reading)
    return caught.value


def test_a_pipe_is_no_map_and_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    os.mkfifo(path)
    assert refused(path).code == "no-file"


@pytest.mark.parametrize(
    ("box", "text"),
    [
        ((-180.0, -90.0, 180.0, -89.9), "latitude -90"),
        ((10.0, 84.9995, 10.001, 85.0005), r"latitude 85"),
        ((-179.9999, 10.0, 179.9999, 10.001), "360 degrees of longitude.*180th meridian"),
        ((10.0, 48.0, 11.5, 48.001), "reaches over 112 km"),
    ],
)
def test_ground_that_is_no_field_is_refused_at_once(
    tmp_path: Path, box: tuple[float, float, float, float], text: str
) -> None:
    found = refused(zones(tmp_path / "rx.geojson", [box], rate_l_ha=[10.0]))
    assert found.code == "out-of-range"
    with pytest.raises(MapError, match=text):
        raise found


def test_cells_across_the_date_line_are_not_called_exchanged() -> None:
    cells = MapCells(
        rates_l_ha=np.ones((5, 10)),
        transform=(1e-4, 0.0, 179.9995, 0.0, -1e-4, 10.0),
        crs=CRS.from_epsg(4326),
    )
    with pytest.raises(MapError, match="180th meridian") as caught:
        check_place(cells, Path("rx.tif"))
    assert caught.value.code == "out-of-range"


def test_an_empty_file_says_so_before_anything_else(tmp_path: Path) -> None:
    assert refused(zones(tmp_path / "rx.geojson", [])).code == "no-polygon"


def test_a_rate_column_without_a_number_is_named(tmp_path: Path) -> None:
    box = (11.0, 48.0, 11.001, 48.001)
    found = refused(zones(tmp_path / "rx.geojson", [box], rate=[None], level=[3.0]), unit="L/ha")
    assert found.code == "null-rate"
    assert "rate is blank in every record" in str(found)


def test_numbers_written_as_text_are_numbers(tmp_path: Path) -> None:
    boxes = [(11.0, 48.0, 11.001, 48.001), (11.001, 48.0, 11.002, 48.001)]
    path = zones(tmp_path / "rx.geojson", boxes, rate=["12.5", " 8 "])
    assert read_map(path, unit="L/ha").rates_l_ha == (8.0, 12.5)
    mixed = zones(tmp_path / "mixed.geojson", boxes, rate=["12.5", "lots"])
    assert refused(mixed, unit="L/ha").code == "no-rate-column"


def test_metres_without_a_crs_are_not_told_to_be_degrees(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(
        "easting,northing,rate_l_ha\n"
        + "".join(f"{686000 + 5 * i},{5330000 + 5 * j},10\n" for i in range(4) for j in range(4))
    )
    found = refused(path)
    assert found.code == "no-crs"
    assert "4326" not in str(found)
    assert "projection" in found.fix


def test_the_rate_with_a_configuration_is_what_is_flown(tmp_path: Path, capsys: Captured) -> None:
    west, south = 114.5436, 36.0
    rx = zones(
        tmp_path / "rx.geojson",
        [(west, south, west + 0.001, south + 0.001)],
        rate_l_ha=[20.0],
    )
    zones(tmp_path / "pond.geojson", [(west, south, west + 0.0002, south + 0.001)])
    zones(tmp_path / "field.geojson", [(west, south, west + 0.0015, south + 0.001)])
    text = Path("examples/anyang/config.toml").read_text()
    begin, end = text.index("[prescription]"), text.index("[boom]")
    config = tmp_path / "config.toml"
    config.write_text(
        text[:begin] + '[prescription]\nfile = "rx.geojson"\nboundary = "field.geojson"\n'
        'exclusions = ["pond.geojson"]\ndefault_rate_l_ha = 15.0\n\n' + text[end:]
    )

    def rate(east_deg: float, *options: str) -> Any:
        place = (str(south + 0.0005), str(west + east_deg))
        assert execute(["map", "rate", str(rx), *place, *options, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        return found["rate_l_ha"], found.get("inside"), found["zone"]

    flown = ("--config", str(config))
    assert rate(0.0001) == (20.0, None, "1")
    assert rate(0.0001, *flown) == (None, False, "1")
    assert rate(0.0005, *flown) == (20.0, True, "1")
    assert rate(0.0012) == (None, None, None)
    assert rate(0.0012, *flown) == (15.0, True, "default")
    assert rate(0.0016, *flown) == (None, False, None)

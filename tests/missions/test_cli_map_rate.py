"""What `vrspray map check` and `map rate` answer of the example and of a map of two zones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.json_answers import CONFIG, MAP, Captured, run_json


def test_map_check_has_the_promised_keys(capsys: Captured) -> None:
    code, found = run_json(capsys, "map", "check", MAP)
    assert code == 0
    promised = "ok format crs unit rate_field zones area_ha rates_l_ha sha256 problems"
    assert set(promised.split()) <= set(found)
    assert (found["ok"], found["zones"], found["unit"]) == (True, 40, "L/ha")
    assert found["area_ha"] == pytest.approx(0.288, abs=1e-4)


def test_map_check_with_a_sprayer_says_what_it_cannot_deliver(
    capsys: Captured, tmp_path: Path
) -> None:
    path = tmp_path / "config.toml"
    path.write_text(Path(CONFIG).read_text().replace("speed_m_s = 5.0", "speed_m_s = 8.0"))
    code, found = run_json(capsys, "map", "check", MAP, "--config", str(path))
    assert code == 0
    assert [problem["code"] for problem in found["problems"]] == ["rate-too-high"]
    path.write_text(path.read_text() + "[product]\nrate_max_l_ha = 20.0\n")
    code, found = run_json(capsys, "map", "check", MAP, "--config", str(path))
    assert (code, found["ok"]) == (1, False)
    assert "above-label" in [problem["code"] for problem in found["problems"]]


def write_map(path: Path, *, overlapping: bool = False, unit: str | None = "L/ha") -> str:
    shift = 0.0005 if overlapping else 0.001
    features = [
        {
            "type": "Feature",
            "properties": {"rate": 10.0 * (number + 1)} | ({"unit": unit} if unit else {}),
            "geometry": {
                "type": "Polygon",
                "coordinates": [
                    [
                        [10.0 + number * shift + x, -35.0 + y]
                        for x, y in ((0, 0), (0.001, 0), (0.001, 0.001), (0, 0.001), (0, 0))
                    ]
                ],
            },
        }
        for number in range(2)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(path)


def test_map_check_tells_errors_from_unreadable_files(capsys: Captured, tmp_path: Path) -> None:
    code, found = run_json(
        capsys, "map", "check", write_map(tmp_path / "overlap.geojson", overlapping=True)
    )
    assert (code, found["ok"]) == (1, False)
    code, found = run_json(capsys, "map", "check", str(tmp_path / "none.shp"))
    assert code == 2
    assert "none.shp" in found["error"]


def test_map_options_answer_what_the_file_leaves_open(capsys: Captured, tmp_path: Path) -> None:
    path = write_map(tmp_path / "unitless.geojson", unit=None)
    assert run_json(capsys, "map", "check", path)[0] == 2
    code, found = run_json(capsys, "map", "check", path, "--unit", "gal/ac")
    assert code == 0
    assert found["rates_l_ha"] == pytest.approx([93.54, 187.08], abs=0.01)


def test_map_options_come_from_the_configuration_where_not_given(
    capsys: Captured, tmp_path: Path
) -> None:
    path = write_map(tmp_path / "unitless.geojson", unit=None)
    config = tmp_path / "config.toml"
    config.write_text(
        Path(CONFIG).read_text().replace("[prescription]", '[prescription]\nunit = "mL/m2"')
    )
    _, found = run_json(capsys, "map", "check", path, "--config", str(config))
    assert found["rates_l_ha"] == [100.0, 200.0]
    _, found = run_json(capsys, "map", "check", path, "--config", str(config), "--unit", "L/ha")
    assert found["rates_l_ha"] == [10.0, 20.0]


def test_map_rate_is_that_of_the_zone_even_south_of_the_equator(
    capsys: Captured, tmp_path: Path
) -> None:
    path = write_map(tmp_path / "south.geojson")
    code, found = run_json(capsys, "map", "rate", path, "-34.9995", "10.0015")
    assert code == 0
    assert found["rate_l_ha"] == 20.0
    assert found["zone"] is not None
    _, outside = run_json(capsys, "map", "rate", path, "-34.9", "10.0015")
    assert (outside["rate_l_ha"], outside["zone"]) == (None, None)
    assert run_json(capsys, "map", "rate", path, "0", "0")[1]["rate_l_ha"] is None


def test_map_rate_answers_a_file_of_points_in_its_order(capsys: Captured, tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.geojson")
    points = tmp_path / "points.csv"
    points.write_text("name,lon,lat\na,10.0015,-34.9995\nb,0,0\nc,10.0005,-34.9995\n")
    code, found = run_json(capsys, "map", "rate", path, "--points", str(points))
    assert code == 0
    assert [row["rate_l_ha"] for row in found["points"]] == [20.0, None, 10.0]
    assert (found["points"][0]["lat"], found["points"][0]["lon"]) == (-34.9995, 10.0015)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"latitude,longitude\n1,2\n", "no columns lat and lon"),
        (b"", "no columns lat and lon"),
        (b"lat,lon\n1,2\n3\n", "line 3"),
        (b"lat,lon\n91,2\n", "line 2"),
        (b"lat,lon\nnan,2\n", "line 2"),
        (b"\xff\xfel\x00", "save it as UTF-8"),
        (b'lat,lon\n"1,2\n' + b"x" * 200_000, "not CSV text"),
    ],
    ids=["names", "empty", "short", "range", "nan", "utf-16", "quotes"],
)
def test_broken_file_of_points_is_refused_in_one_line(
    content: bytes, expected: str, capsys: Captured, tmp_path: Path
) -> None:
    points = tmp_path / "points.csv"
    points.write_bytes(content)
    code, found = run_json(capsys, "map", "rate", MAP, "--points", str(points))
    assert code == 2
    assert expected in found["error"]


@pytest.mark.parametrize(
    "places", [[], ["36"], ["36", "x"], ["91", "0"], ["36", "114", "--points", "x.csv"]], ids=str
)
def test_map_rate_without_a_place_is_refused(places: list[str], capsys: Captured) -> None:
    code, found = run_json(capsys, "map", "rate", MAP, *places)
    assert code == 2
    assert found["error"]

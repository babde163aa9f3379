"""`vrspray map check` on every real set of the samples: usable, or refused for the right reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute

WEIGHT = ("--density-kg-l", "1.25")
LITRES = ("--unit", "L/ha")
SHAPES = "16_shp_pyprecag_edge"


def check(
    capsys: pytest.CaptureFixture[str], path: Path, *options: str
) -> tuple[int, dict[str, Any]]:
    code = execute(["map", "check", str(path), "--json", *options])
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return code, json.loads(printed.out)


@pytest.mark.parametrize(
    ("name", "options", "facts"),
    [
        (
            "01_shp_lha_multipolygon",
            (),
            {"format": "shapefile", "unit": "L/ha", "rate_field": "rate", "zones": 6,
             "parts": 527, "holes": 68, "rates_l_ha": [0.0, 120.0, 140.0, 160.0, 170.0, 180.0]},
        ),
        (
            "03_shp_value_noUnit",
            LITRES,
            {"rate_field": "value", "zones": 8, "parts": 102, "holes": 56},
        ),
        (
            "06_isoxml_v3_grid2_lha",
            (),
            {"format": "isoxml", "rows": 178, "columns": 236, "zones": 178 * 236,
             "rates_l_ha": [0.0, 49.0, 300.0], "default_rate_l_ha": 0.0},
        ),
        (
            "06_isoxml_v3_grid2_lha/grid_type_2.zip",
            (),
            {"rows": 178, "columns": 236, "rates_l_ha": [0.0, 49.0, 300.0]},
        ),
        (
            "08_isoxml_v4_tzn_vector_map1",
            WEIGHT,
            {"format": "isoxml", "unit": "kg/ha", "zones": 32},
        ),
        (
            "14_geotiff_adapt/RasterRx-15.tiff",
            (*WEIGHT, "--rate-field", "Product 3"),
            {"rows": 5, "columns": 10, "zones": 50},
        ),
        (
            f"{SHAPES}/Poly_mga54_SinglePartFieldsTypes_qgis-prj.shp",
            (*LITRES, "--rate-field", "float_area"),
            {"crs": "EPSG:28354", "zones": 3},
        ),
    ],
)  # fmt: skip
def test_a_usable_set_has_its_measured_facts(
    samples: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    options: tuple[str, ...],
    facts: dict[str, object],
) -> None:
    code, found = check(capsys, samples / name, *options)
    assert {key: found[key] for key in facts} == facts
    assert code == (0 if found["ok"] else 1)
    errors = [one["code"] for one in found["problems"] if one["severity"] == "error"]
    assert found["ok"] is (not errors)


@pytest.mark.parametrize(
    ("name", "options", "code"),
    [
        ("01_shp_lha_multipolygon/boundary", (), "no-rate-column"),
        ("03_shp_value_noUnit", (), "no-unit"),
        ("08_isoxml_v4_tzn_vector_map1", (), "not-a-volume"),
        ("10_geojson/app_map_vector.geojson", (), "no-unit"),
        ("11_isoxml_grid1_dotnet", (), "several-sets"),
        ("11_isoxml_grid1_dotnet/TASKDATA.XML", (), "undefined-code"),
        ("11_isoxml_grid1_dotnet/invalid", (), "binary-length"),
        # Its presentation shows ten times what the definition of DDI 6 says.
        ("12_isoxml_grid2_dotnet", WEIGHT, "unit-conflict"),
        ("14_geotiff_adapt", (), "several-layers"),
        ("14_geotiff_adapt/RasterRx-15.tiff", WEIGHT, "several-products"),
        ("14_geotiff_adapt/vector/-49.parquet", WEIGHT, "several-products"),
        (SHAPES, (), "several-layers"),
        (f"{SHAPES}/PointMZ_mga54_MixedPartFieldsTypes_noPrj.shp", (), "no-crs"),
        ("README.md", (), "unknown-format"),
    ],
)
def test_what_cannot_be_flown_is_refused_by_name(
    samples: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    options: tuple[str, ...],
    code: str,
) -> None:
    status, found = check(capsys, samples / name, *options)
    assert status == 2
    assert found["ok"] is False
    assert [one["code"] for one in found["problems"]] == [code]
    assert found["problems"][0]["fix"]


def test_the_border_of_the_geojson_set_hides_nothing(
    samples: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = check(capsys, samples / "10_geojson" / "app_map_vector.geojson", *LITRES)
    assert code == 0
    assert found["rates_l_ha"] == [10.0, 20.0, 30.0]
    assert "null-rate" in [one["code"] for one in found["problems"]]

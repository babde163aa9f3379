"""Spots and a trial on the twin: what really fell, judged by the truth of the flight alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from click.testing import Result
from pyproj import CRS, Transformer
from typer.testing import CliRunner

from analysis.flown.read_applied import read_applied
from companion.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "zones" / "config.toml"
PLANE = CRS.from_proj4("+proj=tmerc +lat_0=48.27 +lon_0=16.9 +k=1 +datum=WGS84")
TO_DEGREES = Transformer.from_crs(PLANE, 4326, always_xy=True)
RIGHT_M = (-2.5, -1.5, -0.5, 0.5, 1.5, 2.5)
# Where the deposit is looked at: pieces of a strip across, and what a place gets from around it.
PIECES = np.linspace(-0.45, 0.45, 10)


@pytest.fixture
def field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a field of 90 m by 24 m, and its configuration."""
    monkeypatch.setattr("companion.cli.app.give_way", lambda *_: None)
    outline = shapely.transform(
        shapely.box(0.0, 0.0, 90.0, 24.0),
        lambda at: np.column_stack(TO_DEGREES.transform(at[:, 0], at[:, 1])),
    )
    feature = {
        "type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(outline)),
    }  # fmt: skip
    (tmp_path / "boundary.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [feature]})
    )
    text = EXAMPLE.read_text().replace('angle_deg = "auto"', "angle_deg = 90.0")
    text = text.replace('fix = "rtk-float"', 'fix = "rtk-fixed"')
    (tmp_path / "config.toml").write_text(text)
    (tmp_path / "flown.toml").write_text(
        text.replace("[mission]", '[mission]\nlines = "job.lines.geojson"')
    )
    return tmp_path


def vrspray(*words: object) -> Result:
    done = CliRunner().invoke(app, [str(one) for one in words], catch_exceptions=False)
    assert done.exit_code in (0, 1), done.output
    return done


def fallen(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return places (longitude, latitude) and millilitres that fell there."""
    frame = read_applied(folder / "flight-0001.gpkg").setup.frame
    with np.load(folder / "truth.npz") as truth:
        heading = np.radians(truth["heading_deg"][1:])
        east, north = truth["east_m"][1:], truth["north_m"][1:]
        given = np.diff(truth["volume_ml"], axis=0)
    places, volumes = [], []
    for valve, right in enumerate(RIGHT_M):
        open_ = given[:, valve] > 0.0
        for piece in PIECES:
            far = right + piece
            x = east[open_] + np.cos(heading[open_]) * far
            y = north[open_] - np.sin(heading[open_]) * far
            latitude, longitude = frame.to_geographic_all(x.tolist(), y.tolist())
            places.append(np.column_stack([longitude, latitude]))
            volumes.append(given[open_, valve] / len(PIECES))
    return np.vstack(places), np.concatenate(volumes)


def metres(degrees: np.ndarray) -> np.ndarray:
    back = Transformer.from_crs(4326, PLANE, always_xy=True)
    return np.column_stack(back.transform(degrees[:, 0], degrees[:, 1]))


def test_weeds_are_hit_and_little_else_is_sprayed(field: Path, not_compared: None) -> None:
    weeds = np.random.default_rng(2).uniform([6.0, 3.0], [84.0, 21.0], (12, 2))
    longitude, latitude = TO_DEGREES.transform(weeds[:, 0], weeds[:, 1])
    rows = [f"{lat:.9f},{lon:.9f}" for lat, lon in zip(latitude, longitude, strict=True)]
    (field / "weeds.csv").write_text("\n".join(["lat,lon", *rows]) + "\n")
    made = json.loads(
        vrspray(
            "make", "spots", field / "weeds.csv", "--config", field / "config.toml", "--rate", "20",
            "--wind-m-s", "0", "--out", field / "map.gpkg", "--mission", field / "job.waypoints",
            "--json",
        ).stdout
    )  # fmt: skip
    assert made["saved_percent"] > 50.0
    vrspray(
        "sitl", "fly", "--config", field / "flown.toml", "--mission", field / "job.waypoints",
        "--out", field / "fly",
    )  # fmt: skip
    places, volume_ml = fallen(field / "fly")
    assert volume_ml.sum() / 1000.0 == pytest.approx(made["litres"], rel=0.06)
    at = metres(places)
    for weed in weeds:
        # Litres a hectare on 1 m2 around the weed.
        near = (np.abs(at - weed) <= 0.5).all(axis=1)
        assert volume_ml[near].sum() * 10.0 > 0.75 * 20.0


def test_plots_get_what_the_evaluation_says(field: Path, not_compared: None) -> None:
    made: dict[str, Any] = json.loads(
        vrspray(
            "make", "trial", "--config", field / "config.toml", "--rates", "15,25", "--rest", "20",
            "--blocks", "2", "--plot-m", "20", "--out", field / "map.gpkg", "--json",
        ).stdout
    )  # fmt: skip
    assert made["ok"]
    vrspray(
        "plan", field / "boundary.geojson", "--config", field / "config.toml",
        "--prescription", field / "map.gpkg", "--out", field / "job.waypoints",
    )  # fmt: skip
    vrspray(
        "sitl", "fly", "--config", field / "flown.toml", "--mission", field / "job.waypoints",
        "--out", field / "fly",
    )  # fmt: skip
    record = field / "map.trial.geojson"
    found = json.loads(
        vrspray("trial", field / "fly" / "flight-0001.gpkg", "--plots", record, "--json").stdout
    )
    assert found["failed"] == 0
    places, volume_ml = fallen(field / "fly")
    at = shapely.points(metres(places))
    inner = {
        one["properties"]["plot"]: shapely.transform(
            shapely.from_geojson(json.dumps(one["geometry"])), metres
        )
        for one in json.loads(record.read_text())["features"]
        if one["properties"]["part"] == "inner"
    }
    for row in found["plots"]:
        area = inner[row["plot"]]
        true_l_ha = volume_ml[shapely.contains(area, at)].sum() * 10.0 / area.area
        assert row["achieved_l_ha"] == pytest.approx(true_l_ha, rel=0.04)
        assert abs(true_l_ha - row["rate_l_ha"]) < 0.05 * row["rate_l_ha"]

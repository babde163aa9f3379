"""`make trial`: blocks, plots and what is recorded, judged by the files alone."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
import typer
from pyproj import CRS, Transformer

from companion.config import load
from companion.errors import ConfigError, VrsprayError
from missions.make.flown import limits_of
from missions.make.trial import Design, lay_out, trial
from missions.maps.cli.options import plan_of

pytestmark = pytest.mark.usefixtures("laid_out_once")

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "zones"
app = typer.Typer(add_completion=False)
app.command()(trial)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trial")
    spec = importlib.util.spec_from_file_location("zones_make", EXAMPLE / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    outline = module.moved(
        shapely.box(0.0, 0.0, 140.0, 42.0),
        Transformer.from_crs(
            CRS.from_proj4("+proj=tmerc +lat_0=48.27 +lon_0=16.9 +k=1 +datum=WGS84"),
            4326, always_xy=True,
        ),
    )  # fmt: skip
    (folder / "boundary.geojson").write_text(
        json.dumps(
            {"type": "FeatureCollection", "features": [
                {"type": "Feature", "properties": {},
                 "geometry": json.loads(shapely.to_geojson(outline))}]}
        )
    )  # fmt: skip
    (folder / "config.toml").write_text((EXAMPLE / "config.toml").read_text())
    return folder


def made(
    capsys: pytest.CaptureFixture[str], data: Path, out: Path, *arguments: object
) -> dict[str, Any]:
    words = ["--config", data / "config.toml", "--out", out, "--rest", "20", "--force", "--json"]
    command = typer.main.get_command(app)
    code = command.main(
        [str(one) for one in (*words, *arguments)], prog_name="trial", standalone_mode=False
    )
    found = json.loads(capsys.readouterr().out)
    assert (code or 0) == (0 if found["ok"] else 1)
    assert isinstance(found, dict)
    return found


def local(geometries: Any) -> Any:
    plane = CRS.from_proj4("+proj=laea +lat_0=48.27 +lon_0=16.9")
    there = Transformer.from_crs(4326, plane, always_xy=True)
    return shapely.transform(
        geometries, lambda at: np.column_stack(there.transform(at[:, 0], at[:, 1]))
    )


def test_the_picture_names_every_plot_its_block_and_its_rate(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "trial.svg"
    found = made(
        capsys, data, tmp_path / "trial.gpkg", "--rates", "15,20", "--blocks", "2", "--plot-m",
        "20", "--angle-deg", "90", "--png", picture,
    )  # fmt: skip
    words = [word.strip() for word in re.findall(r"<!-- (.*?) -->", picture.read_text(), re.DOTALL)]
    for plot in found["plots"]:
        assert f"{plot['plot']}, block {plot['block']}: {plot['rate_l_ha']:g} L/ha" in words


def test_rates_of_the_limits_file_bound_what_is_made(data: Path, tmp_path: Path) -> None:
    limits = tmp_path / "limits.toml"
    limits.write_text('version = 1\ntitle = "a label"\nrate_min_l_ha = 12\nrate_max_l_ha = 22\n')
    given = load(data / "config.toml", overrides=[f'limits.file="{limits}"'])
    sprayer = plan_of(given, None)[0].sprayer
    assert sprayer is not None
    found = limits_of(given, sprayer, 1.5)
    assert (found.low_l_ha, found.high_l_ha) == (12.0, 22.0)
    for text, wrong in (
        ("rate_max_l_ha = 0.1", "rate_max_l_ha = 0.1"),
        ("rate_min_l_ha = 900", "900"),
    ):
        limits.write_text(f'version = 1\ntitle = "a label"\n{text}\n')
        with pytest.raises(ConfigError, match=wrong):
            limits_of(
                load(data / "config.toml", overrides=[f'limits.file="{limits}"']), sprayer, 1.5
            )


def test_every_block_has_every_treatment_once_on_ground_of_its_own(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "trial.gpkg"
    found = made(capsys, data, out, "--rates", "15,20,25", "--check", "10", "--seed", "3")
    assert found["ok"]
    record = json.loads(out.with_name("trial.trial.geojson").read_text())
    assert record["trial"]["seed"] == 3
    assert record["trial"]["check_l_ha"] == 10.0
    of_blocks: dict[int, list[float]] = {}
    for one in found["plots"]:
        of_blocks.setdefault(one["block"], []).append(one["rate_l_ha"])
    assert [sorted(one) for one in of_blocks.values()] == [[10.0, 15.0, 20.0, 25.0]] * 4
    assert len({tuple(one) for one in of_blocks.values()}) > 1
    # The map: as many zones as plots and the rest; they tile the field.
    meta, _, geometries, columns = pyogrio.raw.read(out, layer=0)
    rate = dict(zip(meta["fields"], columns, strict=True))["rate"]
    zones = local(shapely.from_wkb(geometries))
    assert sum(shapely.area(zones)) == pytest.approx(140.0 * 42.0, abs=1.0)
    assert shapely.union_all(zones).area == pytest.approx(140.0 * 42.0, abs=1.0)
    settle = found["settle_m"]
    areas = {"plot": {}, "inner": {}}  # type: ignore[var-annotated]
    for one in record["features"]:
        about = one["properties"]
        area = local(shapely.from_geojson(json.dumps(one["geometry"])))
        areas[about["part"]][about["plot"]] = (area, about["rate_l_ha"])
    for number, (area, wanted) in areas["plot"].items():
        assert area.area == pytest.approx(30.0 * 6.0, rel=0.01)
        inner = areas["inner"][number][0]
        assert inner.area == pytest.approx((30.0 - 2 * settle) * 5.0, rel=0.01)
        assert shapely.distance(inner, area.boundary) == pytest.approx(0.5, abs=0.01)
        at = shapely.intersects(zones, shapely.point_on_surface(inner))
        assert rate[at].tolist() == [wanted]


def test_the_same_seed_makes_the_same_trial(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def plots(seed: int) -> list[dict[str, Any]]:
        out = tmp_path / f"{seed}.geojson"
        found = made(capsys, data, out, "--rates", "15,25", "--seed", seed)["plots"]
        assert isinstance(found, list)
        return found

    assert plots(1) == plots(1)
    assert len({json.dumps(plots(seed)) for seed in range(1, 6)}) > 2


def test_strips_run_as_long_as_the_field(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "strips.gpkg"
    found = made(capsys, data, out, "--rates", "15,25", "--strips", "--blocks", "2")
    assert found["design"] == "strips"
    record = json.loads(out.with_name("strips.trial.geojson").read_text())
    for one in record["features"]:
        if one["properties"]["part"] == "plot":
            area = local(shapely.from_geojson(json.dumps(one["geometry"])))
            # A pass of 6 m, or one beside the overlap that the distance from the border makes.
            assert area.area == pytest.approx((140.0 - 2 * 6.0) * 6.0, rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--rates", "5,20"), "5 L/ha: nozzles and label allow"),
        (("--rates", "15,25", "--plot-m", "2"), "to settle at each end"),
        (("--rates", "15,25", "--blocks", "40"), "would; lower"),
        (("--rates", "15,25", "--headland-m", "60"), "no ground is left"),
        (("--rates", "15,25", "--guard-m", "3"), "nothing is left of 6 m"),
        (("--rates", "15,15"), "none of them twice"),
    ],
)
def test_what_cannot_be_a_trial_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: Any, said: str
) -> None:
    with pytest.raises((VrsprayError, typer.BadParameter), match=said):
        made(capsys, data, tmp_path / "trial.gpkg", *arguments)


def test_plots_keep_clear_of_a_hole_in_the_ground() -> None:
    ground = shapely.box(0, 0, 100, 12).difference(shapely.box(45, 2, 55, 4))
    design = Design(
        rates_l_ha=(10.0, 20.0), blocks=2, plot_m=20.0, wide=1, settle_m=2.0, guard_m=0.5, seed=1
    )
    plots = lay_out(ground, np.array([0.0, 6.0]), design)
    assert len(plots) == 4
    assert all(ground.contains(plot.area()) for plot in plots)

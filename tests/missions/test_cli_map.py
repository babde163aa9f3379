"""`vrspray map check` and `map rate`: what they print, to a person and as JSON."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import shapely
from shapely import Polygon

from companion.cli.app import execute, refusal
from companion.config import load
from companion.errors import MapError
from companion.flight_map import read_flight_map
from companion.flight_map.file import difference
from missions.maps.cli.app import ALIKE_SHOWN_MAX, KINDS_SHOWN_MAX, LINE_MAX, report_lines
from missions.maps.lint import summary
from missions.maps.model import MapFile, Problem
from tests.missions.lint_maps import CELL, SOUTH, WEST, a_map, cell, cells_map

CONFIG = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
Captured = pytest.CaptureFixture[str]
KEYS = {"severity", "code", "text", "where", "fix"}


def run_json(capsys: Captured, *arguments: str) -> tuple[int, dict[str, Any]]:
    code = execute(["map", *arguments, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return code, found


def codes(found: dict[str, Any]) -> list[str]:
    return [problem["code"] for problem in found["problems"]]


def write(path: Path, *zones: tuple[Polygon, float | None], unit: str | None = "L/ha") -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"rate": rate, "name": f"zone{index}"} | ({"unit": unit} if unit else {}),
            "geometry": json.loads(shapely.to_geojson(ground)),
        }
        for index, (ground, rate) in enumerate(zones)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(path)


def write_config(folder: Path, *changes: tuple[str, str], more: str = "") -> str:
    """Write the example's configuration with changes; its boundary is not there."""
    text = CONFIG.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "config.toml"
    path.write_text(text + more, encoding="utf-8")
    return str(path)


# ----------------------------------------------------------------------------------------- refusals


def test_a_refused_map_is_one_object_with_its_problem(capsys: Captured, tmp_path: Path) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 10.0), unit=None)
    code = execute(["map", "check", path, "--json"])
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert code == 2
    assert found["ok"] is False
    assert err == f"error: {found['error']}\n"
    (problem,) = found["problems"]
    assert set(problem) == KEYS
    assert (problem["severity"], problem["code"]) == ("error", "no-unit")
    assert problem["where"] == path
    assert "no unit is given for the rates in rate" in problem["text"]
    assert "--unit" in problem["fix"]
    assert problem["fix"] not in problem["text"]


@pytest.mark.parametrize("command", [["check"], ["rate", "--points", "none.csv"]])
def test_a_file_that_is_not_there_is_refused_by_every_command(
    command: list[str], capsys: Captured
) -> None:
    code, found = run_json(capsys, command[0], "none.shp", *command[1:])
    assert code == 2
    assert found["ok"] is False
    assert [problem["severity"] for problem in found["problems"]] == ["error"]
    assert codes(found) == ["no-file" if len(command) == 1 else "bad-points"]


def test_without_json_a_refusal_is_a_line_on_stderr(capsys: Captured) -> None:
    assert execute(["map", "check", "none.shp"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "error: none.shp: there is no such file; check the path\n"


@pytest.mark.parametrize(
    ("error", "where", "text"),
    [
        (MapError("a.shp: bad; mend it", code="x", fix="mend it"), "a.shp", "bad"),
        (MapError("a.shp: bad: worse; mend it", code="x", fix="mend it"), "a.shp", "bad: worse"),
        (MapError("no file named; mend it", code="x", fix="mend it"), "", "no file named"),
        (MapError("a.shp: all is bad"), "a.shp", "all is bad"),
    ],
)
def test_a_refusal_is_taken_apart(error: MapError, where: str, text: str) -> None:
    assert (refusal(error)["where"], refusal(error)["text"]) == (where, text)


# ---------------------------------------------------------------------------------------- map check


def test_home_is_compared_with_the_map(capsys: Captured, tmp_path: Path) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 10.0))
    near = f"--home={SOUTH},{WEST}"
    assert run_json(capsys, "check", path, near)[1]["problems"] == []
    code, found = run_json(capsys, "check", path, "--home", "-33.5,150.25")
    assert (code, codes(found)) == (1, ["far-from-home"])
    for wrong in ("here", "91,0", "1", "1,2,3", "nan,0"):
        code, found = run_json(capsys, "check", path, "--home", wrong)
        assert (code, "--home" in found["error"]) == (2, True)


def test_depots_of_the_configuration_are_the_home(capsys: Captured, tmp_path: Path) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 25.0))
    config = write_config(tmp_path, ("angle_deg = 12.0", "depots = [[36.5, 114.5]]"))
    code, found = run_json(capsys, "check", path, "--config", config)
    assert (code, codes(found)) == (1, ["far-from-home"])
    near = f"--home={SOUTH},{WEST}"
    assert run_json(capsys, "check", path, near, "--config", config)[1]["problems"] == []


def test_the_boundary_of_the_configuration_is_compared(capsys: Captured, tmp_path: Path) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 25.0), (cell(1), 20.0))
    config = write_config(tmp_path)
    code = execute(["map", "check", path, "--config", config, "--json"])
    out, err = capsys.readouterr()
    assert (code, json.loads(out)["problems"], json.loads(out)["boundary_ha"]) == (0, [], None)
    assert "prescription.boundary" in err
    write(tmp_path / "boundary.geojson", (cell(0), 1.0))
    code, found = run_json(capsys, "check", path, "--config", config)
    assert (code, codes(found)) == (0, ["outside-boundary"])
    assert found["boundary_from"] == "configuration"
    write(tmp_path / "boundary.geojson", (cell(50), 1.0))
    code, found = run_json(capsys, "check", path, "--config", config)
    assert (code, codes(found)) == (1, ["far-from-field"])
    (tmp_path / "boundary.geojson").write_text("{")
    code, found = run_json(capsys, "check", path, "--config", config)
    assert (code, found["ok"]) == (1, False)
    (problem,) = found["problems"]
    assert problem["where"] == "prescription.boundary"
    assert problem["text"].startswith("the boundary cannot be used: ")


def test_what_the_sprayer_cannot_do_is_told_with_speed_and_place(
    capsys: Captured, tmp_path: Path
) -> None:
    path = write(
        tmp_path / "rx.geojson",
        (cell(0, height=0.05), 5.0), (cell(0, 0.05), 25.0), (cell(0, 1.05), 60.0),
    )  # fmt: skip
    config = write_config(tmp_path, ("angle_deg = 12.0", "angle_deg = 0.0"))
    code, found = run_json(capsys, "check", path, "--config", config)
    assert code == 0
    by_code = {problem["code"]: problem for problem in found["problems"]}
    assert set(by_code) == {"short-zone", "rate-too-high", "rate-too-low"}
    assert by_code["short-zone"]["where"].startswith("zone0 at 35.996003, ")
    assert by_code["rate-too-high"]["where"].startswith("60 L/ha: zone2 at ")
    assert by_code["rate-too-low"]["where"].startswith("5 L/ha: zone0 at ")
    assert all("fly at" in problem["fix"] for problem in by_code.values())
    limited = write_config(tmp_path, more="[product]\nrate_max_l_ha = 40.0\n")
    code, found = run_json(capsys, "check", path, "--config", limited)
    assert (code, codes(found)[0]) == (1, "above-label")
    assert found["problems"][0]["where"].startswith("60 L/ha: zone2 at ")


PRODUCT = ((cell(0), 0.8), (cell(5), 1.2))


def test_rates_of_product_are_flown_as_spray_mix(capsys: Captured, tmp_path: Path) -> None:
    path, config = write(tmp_path / "rx.geojson", *PRODUCT), write_config(tmp_path)
    code, found = run_json(capsys, "check", path, "--config", config)
    (asked,) = [each for each in found["problems"] if each["code"] == "other-litres"]
    assert "litres of product?" in asked["text"] and "--mix-rate" in asked["fix"]
    code, found = run_json(capsys, "check", path, "--config", config, "--mix-rate", "20")
    assert (code, found["rates_l_ha"]) == (0, pytest.approx([16.0, 24.0]))
    assert "scaled-rates" in codes(found)
    assert "other-litres" not in codes(found)
    made = str(tmp_path / "mix.geojson")
    assert run_json(capsys, "convert", path, made, "--mix-rate", "20", "--scale", "0.5")[0] == 0
    assert run_json(capsys, "check", made)[1]["rates_l_ha"] == pytest.approx([8.0, 12.0])


def test_rates_of_a_ground_sprayer_are_asked_for_and_scaled(
    capsys: Captured, tmp_path: Path
) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 150.0), (cell(5), 200.0))
    config = write_config(tmp_path)
    _, found = run_json(capsys, "check", path, "--config", config)
    (asked,) = [each for each in found["problems"] if each["code"] == "other-litres"]
    assert "ground sprayer?" in asked["text"] and "--scale" in asked["fix"]
    _, found = run_json(capsys, "check", path, "--config", config, "--scale", "0.1")
    assert found["rates_l_ha"] == pytest.approx([15.0, 20.0])
    assert "other-litres" not in codes(found)


@pytest.mark.parametrize(
    ("option", "value"),
    [("--mix-rate", each) for each in ("nan", "inf", "0.5", "-3", "1e9")]
    + [("--scale", each) for each in ("nan", "inf", "0", "-1", "1e9")],
)
def test_a_factor_that_is_none_is_refused_in_one_line(
    capsys: Captured, tmp_path: Path, option: str, value: str
) -> None:
    path = write(tmp_path / "rx.geojson", *PRODUCT)
    code, found = run_json(capsys, "check", path, option, value)
    assert (code, option[2:].replace("-", "_") in found["error"]) == (2, True)
    assert "\n" not in found["error"]


def test_a_flight_map_remembers_its_factors_and_takes_no_others(
    capsys: Captured, tmp_path: Path
) -> None:
    write(tmp_path / "rx.geojson", *PRODUCT)
    config = write_config(
        tmp_path, more='[application]\nproduct_unit = "L"\nproduct_per_l = 0.05\n'
    )
    text = re.sub(
        r"(?ms)^\[prescription\].*?(?=^\[)",
        '[prescription]\nfile = "rx.geojson"\nmix_rate = 20.0\n\n',
        Path(config).read_text(),
    )
    Path(config).write_text(text)
    out = str(tmp_path / "f.flightmap.gpkg")
    code, found = run_json(
        capsys, "compile", str(tmp_path / "rx.geojson"), "--out", out, "--config", config
    )
    assert (code, found["rates_l_ha"]) == (0, pytest.approx([16.0, 24.0]))
    assert "scaled-rates" in codes(found)
    flight_map = read_flight_map(Path(out))
    assert flight_map.frozen["prescription.mix_rate"] == 20.0
    assert run_json(capsys, "check", out, "--mix-rate", "20")[0] == 0
    assert run_json(capsys, "check", out, "--mix-rate", "10")[0] == 2
    assert run_json(capsys, "check", out, "--scale", "0.1")[0] == 2
    loaded = load(Path(config), overrides=[f"prescription.file={out}"])
    assert difference(flight_map, loaded) is None
    # Without the factor the configuration means another map.
    plain = load(
        Path(config), overrides=[f"prescription.file={out}", "prescription.mix_rate=25.0",
                                 "application.product_per_l=0.04"],
    )  # fmt: skip
    told = difference(flight_map, plain)
    assert told is not None and told[0] == "prescription.mix_rate"
    Path(config).write_text(text.replace("mix_rate = 20.0\n", ""))
    told = difference(flight_map, load(Path(config)))
    assert told == ("prescription.mix_rate", None, 20.0)


def test_a_setting_is_changed_for_one_check_and_for_one_plan(
    capsys: Captured, tmp_path: Path
) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 20.0))
    config = write_config(tmp_path)
    given = ("--config", config, "--set", "product.rate_max_l_ha=15")
    code, found = run_json(capsys, "check", path, *given)
    assert (code, codes(found)[0]) == (1, "above-label")
    out = str(tmp_path / "field.plan")
    words = ("--config", config, "--set", "mission.tank_l=11.0", "--out", out, "--json")
    assert execute(["plan", path, "--rate-l-ha", "20", *words]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert max(one["fill_l"] for one in planned["sorties"]) <= 11.0
    assert all("tank" not in text for text in planned.get("assumed", ()))
    for command in (["map", "check", path], ["plan", path, "--out", out]):
        assert execute([*command, "--set", "mission.tank_l=1"]) == 2
        assert "--config" in capsys.readouterr().err


def test_a_default_rate_that_cannot_be_delivered_is_told(capsys: Captured, tmp_path: Path) -> None:
    path = write(tmp_path / "rx.geojson", (cell(0), 20.0))
    config = write_config(tmp_path, ("[prescription]", "[prescription]\ndefault_rate_l_ha = 90.0"))
    _, found = run_json(capsys, "check", path, "--config", config)
    (problem,) = found["problems"]
    assert (problem["code"], problem["where"]) == ("rate-too-high", "90 L/ha: the default rate")
    assert found["default_rate_l_ha"] == 90.0


# ----------------------------------------------------------------------------------- for a person


def lines_for(given: MapFile, **more: Any) -> list[str]:
    return report_lines(Path("rx.geojson"), summary(given, **more))


def test_the_report_of_zones_has_all_that_a_grower_asks() -> None:
    holed = cell(0, width=3, height=3).difference(cell(1, 1))
    text = "\n".join(
        lines_for(a_map((holed, 10.0), (cell(1, 1), 0.0), boundary=cell(0, width=3, height=3)))
    )
    for part in (
        "rx.geojson: geojson, EPSG:4326",
        "2 zones with 1 hole, 0.0900 ha",
        "rates [L/ha] from 'rate' in L/ha: 0 10",
        "0.8 L in all, 8.889 L/ha on average; 0.010 ha at rate 0",
        "from 35.99600, 114.54300 to 35.99630, 114.54330",
        "boundary: 0.0900 ha, from the map",
        "default rate: none",
    ):
        assert part in text
    assert text.endswith("\nok")


def test_the_report_of_cells_says_rows_columns_and_their_size() -> None:
    lines = lines_for(cells_map([[10.0, float("nan")], [float(r) for r in (20, 30)]]))
    assert "2 rows x 2 columns of cells, 9.02 m x 11.10 m; 3 have a rate, 0.0300 ha" in lines
    many = lines_for(cells_map([[float(rate) for rate in range(1, 21)]]))
    assert "rates [L/ha] from 'rate' in L/ha: 20 from 1 to 20" in many


def test_many_problems_fit_on_a_screen_with_the_worst_first() -> None:
    noted = [
        Problem(severity="warning", code=f"kind-{number % 20}", text="x" * 900, where="w", fix="f")
        for number in range(600)
    ]
    wrong = Problem(severity="error", code="worst", text="bad", where="there", fix="mend it")
    lines = lines_for(a_map((cell(0), 1.0), problems=[*noted, wrong]))
    assert lines[5] == "error: bad (there); mend it [worst]"
    assert len(lines) <= 5 + KINDS_SHOWN_MAX * (ALIKE_SHOWN_MAX + 1) + 2
    assert max(map(len, lines)) <= LINE_MAX
    assert "  and 28 more of the kind kind-0 (--json lists them)" in lines
    assert lines[-2] == "and 6 more kinds of warnings (--json lists them)"
    assert lines[-1] == "not usable: 1 error, 600 warnings"


# ----------------------------------------------------------------------------------------- map rate


def test_places_are_answered_in_words(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    given = a_map((cell(0), 10.0), (cell(1), None), (cell(2), 20.0), boundary=cell(0, width=2))
    monkeypatch.setattr("missions.maps.cli.options.read_map", lambda *_, **__: given)

    def said(column: float) -> str:
        longitude = WEST + column * CELL
        assert execute(["map", "rate", "rx", f"{SOUTH + CELL / 2}", f"{longitude}"]) == 0
        return capsys.readouterr().out.partition(": ")[2].rstrip("\n")

    assert said(0.5) == "10 L/ha in zone zone0"
    assert said(1.5) == "no rate in zone zone1"
    assert said(2.5) == "20 L/ha in zone zone2, outside the field's boundary"
    assert said(9.0) == "no rate, outside the field's boundary"


def test_cells_are_answered_for_a_file_of_points(
    capsys: Captured, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = cells_map([[10.0, 20.0], [float("nan"), 0.0]])
    monkeypatch.setattr("missions.maps.cli.options.read_map", lambda *_, **__: given)
    rows = [(SOUTH + up * CELL, WEST + right * CELL) for up in (1.5, 0.5) for right in (0.5, 1.5)]
    points = tmp_path / "points.csv"
    points.write_text("lat,lon\n" + "".join(f"{lat},{lon}\n" for lat, lon in rows))
    code, found = run_json(capsys, "rate", "rx", "--points", str(points))
    assert code == 0
    assert [row["rate_l_ha"] for row in found["points"]] == [10.0, 20.0, None, 0.0]


def test_the_offset_between_map_and_receiver_is_ready_to_paste(capsys: Captured) -> None:
    marks = ("--map", "-36.0,114.5", "--surveyed", "-36.000005,114.500005")
    code, found = run_json(capsys, "offset", *marks)
    assert code == 0
    # 5e-6 degrees there: 0.451 m east, 0.555 m south.
    assert found["offset_east_m"] == pytest.approx(0.451, abs=1e-3)
    assert found["offset_north_m"] == pytest.approx(-0.555, abs=1e-3)
    assert execute(["map", "offset", *marks]) == 0
    assert "check_surveyed = [-36.000005, 114.500005]" in capsys.readouterr().out


@pytest.mark.parametrize("surveyed", ["-36.1,114.5", "here", "114.5,-36.0"])
def test_another_mark_and_no_place_are_refused(capsys: Captured, surveyed: str) -> None:
    assert execute(["map", "offset", "--map", "-36.0,114.5", "--surveyed", surveyed]) == 2
    assert "--surveyed" in capsys.readouterr().err


def test_overlap_policy_is_asked_for_check_and_rate(capsys: Captured, tmp_path: Path) -> None:
    path = tmp_path / "two.csv"
    path.write_text(
        "wkt;rate\n"
        "POLYGON((114.5 36,114.502 36,114.502 36.001,114.5 36.001,114.5 36));10\n"
        "POLYGON((114.501 36,114.503 36,114.503 36.001,114.501 36.001,114.501 36));30\n"
    )
    given = (str(path), "--unit", "L/ha")
    code, found = run_json(capsys, "check", *given)
    assert (code, found["ok"]) == (1, False)
    code, found = run_json(capsys, "check", *given, "--overlap", "max")
    assert (code, found["ok"]) == (0, True)
    assert "the larger rate applies there" in found["problems"][0]["text"]
    for policy, rate_l_ha in (("max", 30.0), ("min", 10.0), ("mean", 20.0), ("last", 30.0)):
        place = ("36.0005", "114.5015", "--overlap", policy)
        assert run_json(capsys, "rate", *given, *place)[1]["rate_l_ha"] == rate_l_ha
    assert execute(["map", "check", *given, "--overlap", "first"]) == 2
    assert "--overlap is one of error, max, min, mean, last" in capsys.readouterr().err

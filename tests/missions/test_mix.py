"""What goes into the tank: amounts by hand, the order of mixing, and that nothing gets lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import box

from companion.cli.app import execute
from companion.config import Config, load
from companion.config.tables import MixTable
from missions.demand import Uniform
from missions.mix import STEPS, UNITS, flown_rates, mix_lines, mix_of
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.strips import Floats
from tests.missions.test_missions_cli import written
from tests.missions.test_missions_plan import field_of
from tests.missions.test_missions_sheet import planned

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

ANYANG = Path(__file__).parents[2] / "examples/anyang/config.toml"
# Twenty passes of 6 m and 100 m, a hair closer than 6 m: 1.2 ha at 20 L/ha are 24 L.
FIELD, HA, RATE_L_HA, RESERVE_L = box(0, 0, 119.9, 100), 1.2, 20.0, 1.5
MISSION = f"""
[mission]
swath_width_m = 6.0
speed_m_s = 6.0
tank_l = 9.0
reserve_l = {RESERVE_L}
rate_l_ha = {RATE_L_HA}
angle_deg = 0.0
"""
MIX = """
[[mix]]
name = "Oil"
formulation = "oil"
amount = 0.5
unit = "%"

[[mix]]
name = "Alpha <EC>"
registration = "024-1"
formulation = "EC"
amount = 500
unit = "mL/ha"

[[mix]]
name = "Beta"
formulation = "WG"
amount = 0.05
unit = "kg/ha"
"""


def configured(folder: Path, *tables: str) -> Path:
    text = ANYANG.read_text()
    for table in ("mission", "product", "application", "prescription"):
        before, mark, after = text.partition(f"[{table}]")
        if mark:
            text = before + after[after.index("\n[") if "\n[" in after else len(after) :]
    path = folder / "config.toml"
    path.write_text("".join([text, *tables]))
    return path


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    return load(configured(tmp_path_factory.mktemp("mix"), MISSION))


@pytest.fixture(scope="module")
def plan() -> Plan:
    settings = Settings(
        swath_width_m=6.0, speed_m_s=6.0, tank_l=9.0, reserve_l=RESERVE_L, aircraft=2, angle_deg=0.0
    )
    return plan_mission(field_of(FIELD), settings, Uniform(rate_l_ha=RATE_L_HA))


def mixed(config: Config, plan: Plan, *entries: dict[str, Any]) -> dict[str, Any]:
    rows = tuple(MixTable.model_validate({"name": "A"} | each) for each in entries)
    found = mix_of(config.model_copy(update={"mix": rows}), plan, Uniform(rate_l_ha=RATE_L_HA))
    assert found is not None
    return found


def test_amounts_are_those_worked_out_by_hand(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = configured(tmp_path, MISSION, MIX)
    field = written(FIELD, tmp_path / "f.geojson")
    found = planned(capsys, field, "--config", path, "--out", tmp_path / "m.kml")
    mix = found["mix"]
    assert found["volume_l"] == pytest.approx(HA * RATE_L_HA, rel=2e-3)
    # Hectares times rate lie on the field; 1.5 L of the 20 L of a hectare are left over.
    by_hand = {
        "Beta": (HA * 0.05, 1.5 / 20 * 0.05),
        "Alpha <EC>": (HA * 0.5, 1.5 / 20 * 0.5),
        "Oil": (24.0 * 0.005, 1.5 * 0.005),
    }
    assert [each["name"] for each in mix["products"]] == list(by_hand)
    for each in mix["products"]:
        on_field, left = by_hand[each["name"]]
        assert each["sprayed"] == pytest.approx(on_field, rel=2e-3)
        assert each["leftover"] == pytest.approx(left)
        assert each["total"] == pytest.approx(on_field + left, rel=2e-3)
    assert [each["measure"] for each in mix["products"]] == ["kg", "L", "L"]
    for row, sortie in zip(mix["sorties"], found["sorties"], strict=True):
        assert row["mix_l"] == pytest.approx(sortie["add_l"])
        # A litre holds 25 mL of the one liquid and 5 mL of the other.
        assert row["water_l"] == pytest.approx(sortie["add_l"] * (1 - 0.025 - 0.005))
        assert row["amounts"] == pytest.approx(
            [sortie["add_l"] * share for share in (0.0025, 0.025, 0.005)]
        )


def test_what_is_in_the_tank_is_not_mixed_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = configured(tmp_path, MISSION, MIX)
    field = written(FIELD, tmp_path / "f.geojson")
    out = tmp_path / "m.kml"

    def made(*words: object) -> dict[str, Any]:
        return planned(capsys, field, "--config", path, "--out", out, "--force", *words)

    empty, some = made(), made("--in-tank-l", 4.0)
    adds = [[one["add_l"] for one in found["sorties"]] for found in (empty, some)]
    assert adds[1] == pytest.approx([adds[0][0] - 4.0, *adds[0][1:]])
    assert some["sorties"][0]["fill_l"] == pytest.approx(empty["sorties"][0]["fill_l"])
    for before, after in zip(empty["mix"]["products"], some["mix"]["products"], strict=True):
        assert after["total"] == pytest.approx(before["total"] - 4.0 * after["per_l"])
        assert after["leftover"] == pytest.approx(before["leftover"])
    assert "4 L are in the tank" in some["mix"]["notes"][0]
    # More than the first sortie needs serves the next one too, and nothing is poured out.
    small = made("--in-tank-l", 9.0, "--rate-l-ha", 5.0)
    first = small["sorties"][0]
    assert first["add_l"] == pytest.approx(max(first["needs_l"] + RESERVE_L - 9.0, 0.0))
    # At 5 L/ha nozzles give more than is asked, and that is gone too.
    total_l = sum(one["add_l"] for one in small["sorties"])
    assert small["treated_l"] > small["volume_l"]
    assert small["mix"]["leftover_l"] == pytest.approx(9.0 + total_l - small["treated_l"])
    sheet = tmp_path / "sheet.txt"
    made("--in-tank-l", 4.0, "--sheet", sheet)
    assert "beside the 4 L that are in the tank" in sheet.read_text()
    for words in (("--in-tank-l", "9.1"), ("--in-tank-l", "1", "--aircraft", "2")):
        given = ["plan", str(field), "--config", str(path), "--out", str(out), "--force", *words]
        assert execute(given) == 2
        assert "--in-tank-l" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("unit", "amount", "measure", "per_l"),
    [
        ("L/ha", 0.5, "L", 0.025), ("mL/ha", 500.0, "L", 0.025), ("kg/ha", 2.0, "kg", 0.1),
        ("g/ha", 80.0, "kg", 0.004), ("%", 0.5, "L", 0.005), ("L/100 L", 0.5, "L", 0.005),
        ("mL/100 L", 250.0, "L", 0.0025), ("kg/100 L", 1.0, "kg", 0.01),
        ("g/100 L", 50.0, "kg", 0.0005),
    ],
)  # fmt: skip
def test_every_unit_is_a_share_of_the_mix(
    config: Config, plan: Plan, unit: str, amount: float, measure: str, per_l: float
) -> None:
    (found,) = mixed(config, plan, {"amount": amount, "unit": unit})["products"]
    assert (found["measure"], found["per_l"]) == (measure, pytest.approx(per_l, rel=1e-6))


def test_every_unit_and_formulation_of_the_configuration_is_known_here() -> None:
    schema = MixTable.model_json_schema()["properties"]
    assert set(schema["unit"]["enum"]) == {*UNITS}
    codes = [code for codes in STEPS.values() for code in codes]
    assert sorted(schema["formulation"]["anyOf"][0]["enum"]) == sorted(codes)


def test_products_are_mixed_in_the_order_of_the_trade(config: Config, plan: Plan) -> None:
    # W-A-L-E-S, a conditioner before and a fertilizer after it; what says nothing comes last.
    order = ["conditioner", "WP", "SC", "EC", "SL", "surfactant", "fertilizer", None]
    entries = [{"formulation": code, "amount": 1.0, "unit": "g/ha"} for code in reversed(order)]
    found = mixed(config, plan, *entries)["products"]
    assert [each["formulation"] for each in found] == order
    assert "label" in found[-1]["step"]
    same = [{"name": name, "formulation": "SC", "amount": 1.0, "unit": "%"} for name in "CAB"]
    assert [each["name"] for each in mixed(config, plan, *same)["products"]] == list("CAB")


doses = st.lists(
    st.fixed_dictionaries(
        {
            "amount": st.floats(0.001, 1.0),
            "unit": st.sampled_from(sorted(UNITS)),
            "formulation": st.sampled_from([None, "SC", "WG", "EC", "conditioner"]),
        }
    ),
    min_size=1, max_size=6,
)  # fmt: skip


@given(doses)
def test_nothing_gets_lost_between_cans_tanks_field_and_leftover(
    config: Config, plan: Plan, entries: list[dict[str, Any]]
) -> None:
    found = mixed(config, plan, *entries)
    liquids = [each["measure"] == "L" for each in found["products"]]
    for at, each in enumerate(found["products"]):
        poured = sum(row["amounts"][at] for row in found["sorties"])
        assert poured == pytest.approx(each["total"])
        assert each["sprayed"] + each["leftover"] == pytest.approx(each["total"])
        if each["unit"].endswith("/ha"):
            share = 1.0 if each["unit"][0] in "Lk" else 0.001
            assert each["sprayed"] == pytest.approx(HA * each["amount"] * share, rel=2e-3)
    for row in found["sorties"]:
        parts = [
            row["water_l"],
            *(a for a, is_l in zip(row["amounts"], liquids, strict=True) if is_l),
        ]
        assert sum(parts) == pytest.approx(row["mix_l"])
    # Two aircraft have two reserves.
    assert found["leftover_l"] == pytest.approx(2 * RESERVE_L)
    assert found["mix_l"] == pytest.approx(plan.volume_l + 2 * RESERVE_L)


def two_zones(path: Path) -> Path:
    """Write 1.2 ha, half of them at 10 and half at 30 L/ha."""
    halves = []
    for rate, (west, east) in ((10.0, (-1, 59.95)), (30.0, (59.95, 121))):
        half = json.loads(written(box(west, -1, east, 101), path).read_text())
        geometry = half["features"][0]["geometry"] if "features" in half else half
        halves.append({"type": "Feature", "properties": {"rate": rate}, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": halves}))
    return path


def test_by_a_map_a_product_follows_the_rates_and_its_average_is_the_dose(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field, zones = written(FIELD, tmp_path / "f.geojson"), two_zones(tmp_path / "z.geojson")
    words = ["--prescription", zones, "--unit", "L/ha"]
    path = configured(tmp_path, MISSION, MIX)
    mix = planned(capsys, field, "--config", path, *words, "--out", tmp_path / "m.kml")["mix"]
    assert mix["rate_mean_l_ha"] == pytest.approx(20.0, rel=2e-3)
    alpha = mix["products"][1]
    assert alpha["per_l"] == pytest.approx(0.5 / 20.0, rel=2e-3)
    assert alpha["sprayed"] == pytest.approx(0.6, rel=5e-3)
    assert (alpha["per_ha_min"], alpha["per_ha_max"]) == pytest.approx((0.25, 0.75), rel=5e-3)
    assert any("Alpha <EC>: a hectare gets 249.8 mL to 749.4 mL" in note for note in mix["notes"])
    # The label's rate as the most that a hectare gets.
    held = configured(tmp_path, MISSION, MIX.replace('"mL/ha"', '"mL/ha"\nat_l_ha = 30'))
    mix = planned(capsys, field, "--config", held, *words, "--out", tmp_path / "m.kml")["mix"]
    assert mix["products"][1]["per_ha_max"] == pytest.approx(0.5)
    assert not any("Alpha" in note for note in mix["notes"])


class Half:
    """30 L/ha in the east, 0 in the west, and no rate beyond 110 m."""

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        return np.where(east_m > 110.0, np.nan, np.where(east_m > 60.0, 30.0, 0.0))


def test_ground_that_is_not_sprayed_has_no_part_in_the_average(plan: Plan) -> None:
    found = flown_rates(plan, Half())
    assert (found.mean_l_ha, found.low_l_ha, found.high_l_ha) == pytest.approx((30.0, 30.0, 30.0))


def test_the_sheet_shows_what_to_pour_sortie_by_sortie(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path, field = configured(tmp_path, MISSION, MIX), written(FIELD, tmp_path / "f.geojson")
    words = ["--config", path, "--out", tmp_path / "m.kml", "--sheet"]
    mix = planned(capsys, field, *words, tmp_path / "s.txt")["mix"]
    lines = (tmp_path / "s.txt").read_text().splitlines()
    start = next(at for at, line in enumerate(lines) if line.startswith("mix for"))
    assert lines[start].split("  ")[-1].strip() == "water up to"
    assert [lines[start].index(name) for name in ("1. Beta", "2. Alpha", "3. Oil")] == sorted(
        lines[start].index(name) for name in ("1. Beta", "2. Alpha", "3. Oil")
    )
    row = mix["sorties"][0]
    assert lines[start + 3].split() == [
        "1", f"{row['water_l'] / 2:.2f}", f"{row['amounts'][0] * 1000:.1f}",
        f"{row['amounts'][1] * 1000:.1f}", f"{row['amounts'][2] * 1000:.1f}",
        f"{row['mix_l']:.2f}",
    ]  # fmt: skip
    text = "\n".join(lines)
    assert "Alpha <EC> (EC, 024-1), 500 mL/ha, emulsifiable: 637." in text
    assert "3 times with 5.00 L of clean water" in text
    planned(capsys, field, *words, tmp_path / "s.html")
    page = (tmp_path / "s.html").read_text()
    assert "2. Alpha &lt;EC&gt;<br>mL" in page and "Alpha <EC>" not in page
    assert page.count("<table>") == 2


@pytest.mark.parametrize(
    ("keys", "water_l", "percent"),
    [
        # 1.5 L left and 15 L of water: 1.5 / 6.5 three times over is 1.229 %.
        ({}, 15.0, 1.229),
        # In one go it is 1.5 / 16.5.
        ({"rinses": 1}, 15.0, 9.091),
        ({"rinse_l": 3.0}, 3.0, 100 * 0.6**3),
    ],
)
def test_rinsing_thins_what_is_left_as_worked_out_by_hand(
    config: Config, plan: Plan, keys: dict[str, float], water_l: float, percent: float
) -> None:
    assert config.mission is not None
    told = config.model_copy(update={"mission": config.mission.model_copy(update=keys)})
    found = mixed(told, plan, {"amount": 1.0, "unit": "%"})
    rinse = found["rinse"]
    assert (rinse["water_l"], rinse["left_percent"]) == (water_l, pytest.approx(percent, rel=1e-3))
    assert ("more than 2 %, take more" in mix_lines(found)[-1]) == (percent > 2.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("\"EC\"", "\"ECC\""), "mix[1].formulation"),
        (("unit = \"%\"", "unit = \"oz\""), "mix[0].unit"),
        (("unit = \"%\"", "unit = \"%\"\nat_l_ha = 20"), "at_l_ha is for an amount for each"),
        (("amount = 0.05", "amount = 0"), "mix[2].amount"),
        (("amount = 500\n", "amount = 20000\n"), "mix[1].amount"),
        (("amount = 0.5\n", "amount = 99\n"), "mix: the products alone come to 1.01 L"),
    ],
)  # fmt: skip
def test_what_cannot_be_mixed_is_refused_in_one_line_and_nothing_is_written(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    path = configured(tmp_path, MISSION, MIX.replace(*change))
    field = written(FIELD, tmp_path / "f.geojson")
    assert (
        execute(["plan", str(field), "--config", str(path), "--out", str(tmp_path / "m.kml")]) == 2
    )
    err = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(err) == 1 and said in err[0]
    assert not list(tmp_path.glob("m*"))


def test_a_mix_that_the_record_states_otherwise_is_told(config: Config, plan: Plan) -> None:
    for per_l, count in ((0.0025, 0), (0.004, 1)):
        told = config.model_copy(
            update={
                "product": config.product.model_copy(update={"name": "A"}),
                "application": config.application.model_copy(update={"product_per_l": per_l}),
            }
        )
        notes = mixed(told, plan, {"amount": 50.0, "unit": "g/ha"})["notes"]
        assert len([note for note in notes if "application.product_per_l" in note]) == count


def test_a_plan_without_products_has_no_mix(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    found = planned(capsys, field, "--out", tmp_path / "m.kml", "--sheet", tmp_path / "s.txt")
    assert found["mix"] is None
    assert "mix for" not in (tmp_path / "s.txt").read_text()

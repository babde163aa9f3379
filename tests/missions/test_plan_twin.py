"""A plan's litres are those that the twin sprays, ferries and side steps included."""

from __future__ import annotations

import json
from pathlib import Path

import shapely
from shapely import Polygon, box

from missions.maps.compiling import compiled_setup
from tests.bench.missions import to_degrees
from tests.bench.plan_twin import compared, config_for, flown, planned, with_lines


def features(path: Path, areas: list[tuple[Polygon, dict[str, float]]]) -> Path:
    found = [
        {"type": "Feature", "properties": properties,
         "geometry": json.loads(shapely.to_geojson(to_degrees(area)))}
        for area, properties in areas
    ]  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": found}))
    return path


def test_litres_of_every_sortie_agree_with_the_twin_within_two_percent(tmp_path: Path) -> None:
    whole = Polygon([(0, 0), (38, 5), (44, 70), (6, 76)])
    rates = [
        (whole & box(-9, -9, 99, 25), {"rate": 180.0}),
        (whole & box(-9, 25, 99, 48), {"rate": 0.0}),
        (whole & box(-9, 48, 99, 199), {"rate": 120.0}),
    ]
    map_file = features(tmp_path / "rates.geojson", rates)  # type: ignore[arg-type]
    boundary = features(tmp_path / "field.geojson", [(whole, {})])
    config = config_for(tmp_path, map_file, boundary)
    plan = planned(config, boundary, moves=2_000, tank_l=13.0)
    assert len(plan.sorties) >= 2
    setup = compiled_setup(with_lines(plan, config), frame=plan.frame)
    found = compared([flown(plan, sortie, setup, seed=1) for sortie in plan.sorties])
    # Valves close over treated ground in squares of 0.2 m.
    assert found["worst_percent"] < 1.5, found
    assert abs(found["total_percent"]) < 0.5, found
    # Lines that end at full speed, where bare ground begins: the noise of the position, some 3 cm.
    assert max(sortie["off_lines_ml"] for sortie in found["sorties"]) < 10.0

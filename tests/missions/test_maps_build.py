"""From a map to the prescription that flies, and what `map check` and `map rate` say of it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from pyproj import Geod
from shapely import MultiPolygon, Polygon, box

from companion.errors import MapError
from missions.maps.build import build_prescription, frame_for, project
from missions.maps.lint import check_map, point_rates, summary
from missions.maps.model import MapFile
from tests.missions.lint_maps import a_map

WEST, SOUTH, CELL = 114.543, 35.996, 0.001


def cell(column: float, row: float = 0.0, *, width: float = 1.0) -> Polygon:
    west, south = WEST + column * CELL, SOUTH + row * CELL
    return box(west, south, west + width * CELL, south + CELL)


def codes(map_file: MapFile, **more: str) -> list[str]:
    return [problem.code for problem in check_map(map_file, **more)]


NEIGHBOURS = a_map((cell(0), 10.0), (cell(1), 20.0))


def test_the_frame_stands_in_the_middle_of_the_map() -> None:
    frame = frame_for(NEIGHBOURS)
    assert frame.longitude_deg == pytest.approx(WEST + CELL)
    assert frame.latitude_deg == pytest.approx(SOUTH + CELL / 2)


def test_every_zone_keeps_its_rate_and_ground() -> None:
    prescription = build_prescription(NEIGHBOURS, frame_for(NEIGHBOURS))
    assert prescription.sha256 == "abc"
    assert prescription.rate_at(-20.0, 0.0) == 10.0
    assert prescription.rate_at(20.0, 0.0) == 20.0
    assert prescription.rate_at(500.0, 0.0) is None
    area_m2, _ = Geod(ellps="WGS84").geometry_area_perimeter(cell(0, width=2.0))
    assert prescription.area_m2 == pytest.approx(area_m2, rel=1e-6)


def test_a_zone_without_a_rate_is_left_out_and_zero_is_not() -> None:
    found = a_map((cell(0), None), (cell(1), 0.0))
    prescription = build_prescription(found, frame_for(found))
    assert [zone.name for zone in prescription.zones] == ["zone1"]
    assert "null-rate" in codes(found)


def test_a_map_without_any_rate_is_refused() -> None:
    found = a_map((cell(0), None))
    with pytest.raises(MapError, match="nothing has a rate"):
        build_prescription(found, frame_for(found))
    assert summary(found)["ok"] is False


OVERLAPPING = a_map((cell(0), 10.0), (cell(0.5), 20.0))


def test_overlaps_are_refused_with_both_names_the_area_and_the_setting() -> None:
    frame = frame_for(OVERLAPPING)
    with pytest.raises(
        MapError, match=r"zones zone0 and zone1 overlap by 50\d\d\.\d m2; .*prescription\.overlap"
    ):
        build_prescription(OVERLAPPING, frame)


@pytest.mark.parametrize(
    ("overlap", "rate"), [("max", 20), ("min", 10), ("mean", 15), ("last", 20)]
)
def test_overlaps_follow_the_policy_that_is_set(overlap: str, rate: float) -> None:
    frame = frame_for(OVERLAPPING)
    assert build_prescription(OVERLAPPING, frame, overlap=overlap).rate_at(0.0, 0.0) == rate


def test_a_policy_that_does_not_exist_is_refused() -> None:
    with pytest.raises(MapError, match=r"prescription\.overlap is 'first'; take one of error"):
        build_prescription(NEIGHBOURS, frame_for(NEIGHBOURS), overlap="first")


def test_a_zone_without_a_rate_may_lie_over_the_others() -> None:
    found = a_map((cell(0), 10.0), (cell(0, width=2.0), None))
    frame = frame_for(found)
    assert build_prescription(found, frame).rate_at(-20.0, 0.0) == 10.0
    assert "overlap" not in codes(found)


def test_a_digitising_error_is_no_overlap() -> None:
    # 1e-8 degrees are 0.9 mm; over 111 m that is 0.1 m2.
    found = a_map((cell(0, width=1 + 1e-5), 10.0), (cell(1), 20.0))
    build_prescription(found, frame_for(found))
    assert codes(found) == []


def test_many_parts_that_overlap_a_little_are_added_up() -> None:
    strips = [box(WEST, SOUTH + i * 2e-5, WEST + 1e-5, SOUTH + i * 2e-5 + 1e-5) for i in range(4)]
    found = a_map((MultiPolygon(strips), 10.0), (box(WEST, SOUTH, WEST + 5e-6, SOUTH + 1e-3), 20.0))
    assert "overlap" in codes(found)


def test_the_offset_moves_zones_boundary_and_exclusions_together() -> None:
    frame = frame_for(NEIGHBOURS)
    moved = build_prescription(
        NEIGHBOURS,
        frame,
        boundary=MultiPolygon([cell(0, width=2.0)]),
        exclusions=[MultiPolygon([cell(0, width=0.5)])],
        offset_east_m=300.0,
        offset_north_m=-40.0,
    )
    still = build_prescription(
        NEIGHBOURS,
        frame,
        boundary=MultiPolygon([cell(0, width=2.0)]),
        exclusions=[MultiPolygon([cell(0, width=0.5)])],
    )
    for east_m in (-80.0, -20.0, 20.0, 100.0):
        assert moved.rate_at(east_m + 300.0, -40.0) == still.rate_at(east_m, 0.0)
    assert moved.field.bounds[0] == pytest.approx(still.field.bounds[0] + 300.0, abs=1e-6)
    assert still.rate_at(-80.0, 0.0) is None
    assert still.rate_at(-20.0, 0.0) == 10.0


def test_a_boundary_limits_where_spraying_is_allowed() -> None:
    boundary = MultiPolygon([cell(0.5)])
    prescription = build_prescription(NEIGHBOURS, frame_for(NEIGHBOURS), boundary=boundary)
    assert prescription.rate_at(-20.0, 0.0) == 10.0
    assert prescription.rate_at(-60.0, 0.0) is None


def test_a_long_edge_beside_short_ones_leaves_neither_gap_nor_overlap() -> None:
    # 4 km along a parallel: the chord in metres and the line in degrees part by 23 cm.
    west = [box(WEST + i * 0.004, SOUTH, WEST + (i + 1) * 0.004, SOUTH + CELL) for i in range(11)]
    above = box(WEST, SOUTH + CELL, WEST + 0.044, SOUTH + 2 * CELL)
    found = a_map((above, 5.0), *((ground, 6.0) for ground in west))
    assert codes(found) == []
    assert build_prescription(found, frame_for(found)).rate_at(0.0, 20.0) == 5.0


def test_one_geometry_is_projected_to_the_length_on_the_ellipsoid() -> None:
    frame = frame_for(NEIGHBOURS)
    ground = project(cell(0), frame)
    _, _, width_m = Geod(ellps="WGS84").inv(WEST, SOUTH, WEST + CELL, SOUTH)
    assert ground.bounds[2] - ground.bounds[0] == pytest.approx(width_m, abs=0.01)


def test_the_summary_has_the_keys_that_others_rely_on() -> None:
    found = summary(NEIGHBOURS)
    assert {
        "ok", "format", "crs", "unit", "rate_field", "zones", "area_ha", "rates_l_ha", "sha256",
        "problems",
    } <= set(found)  # fmt: skip
    area_m2, _ = Geod(ellps="WGS84").geometry_area_perimeter(cell(0, width=2.0))
    assert found["ok"] is True
    assert found["zones"] == 2
    assert found["rates_l_ha"] == [10.0, 20.0]
    assert found["area_ha"] == pytest.approx(area_m2 / 10_000, rel=1e-6)


def test_an_overlap_fails_the_check_only_under_its_policy() -> None:
    assert summary(OVERLAPPING)["ok"] is False
    assert summary(OVERLAPPING, overlap="max")["ok"] is True
    assert "overlap" in codes(OVERLAPPING, overlap="max")


def problem_zones() -> list[tuple[str, Sequence[tuple[Polygon, float | None]]]]:
    return [
        ("small-part", [(cell(0), 1.0), (cell(3, width=5e-5), 1.0)]),
        ("sliver", [(cell(0), 1.0), (cell(3, width=5e-4), 1.0)]),
        ("gap", [(cell(0), 1.0), (cell(1.005), 1.0)]),
        ("far-apart", [(cell(0), 1.0), (cell(300), 1.0)]),
        ("all-zero", [(cell(0), 0.0)]),
        ("high-rate", [(cell(0), 5_000.0)]),
        ("rate-apart", [(cell(0), 20.0), (cell(1), 24.0), (cell(2), 254.0)]),
        ("null-rate", [(cell(0), None), (cell(1), 1.0)]),
        ("odd-place", [(box(0.0, 0.0, CELL, CELL), 1.0)]),
        ("odd-place", [(box(36.0, 81.0, 36.0 + CELL, 81.0 + CELL), 1.0)]),
    ]


@pytest.mark.parametrize(("code", "zones"), problem_zones())
def test_every_oddity_is_told(code: str, zones: Sequence[tuple[Polygon, float | None]]) -> None:
    assert code in codes(a_map(*zones))


def test_rates_a_few_times_apart_are_no_oddity() -> None:
    assert codes(a_map((cell(0), 0.0), (cell(1), 5.0), (cell(2), 40.0))) == []


def test_a_sound_map_has_no_problems() -> None:
    ring = cell(0).difference(cell(0).buffer(-CELL / 4))
    assert codes(a_map((ring, 10.0), (cell(0).buffer(-CELL / 4), 20.0), (cell(1), 30.0))) == []


def test_points_are_answered_in_their_order_with_rate_and_zone() -> None:
    found = a_map((cell(0), 10.0), (cell(1), 20.0), (cell(2), None))
    middle = SOUTH + CELL / 2
    points = [(middle, WEST + share * CELL) for share in (1.5, 0.5, 2.5, 9.0, 1.0)]
    rows = point_rates(found, [*points, (float("nan"), 0.0)])
    assert [row["rate_l_ha"] for row in rows] == [20.0, 10.0, None, None, 10.0, None]
    assert [row["zone"] for row in rows[:5]] == ["zone1", "zone0", "zone2", None, "zone0"]
    assert (rows[0]["lat"], rows[0]["lon"]) == points[0]
    assert point_rates(found, []) == []


def test_a_thousand_layers_on_the_same_ground_do_not_take_all_pairs() -> None:
    layers = [cell(0, width=1 + i * 1e-6) for i in range(1500)]
    found = a_map(*((ground, 1.0) for ground in layers))
    with pytest.raises(MapError, match=r"overlap by .* \(and at least [1-9]\d{3} more pairs\)"):
        build_prescription(found, frame_for(found))


@pytest.mark.parametrize("rates", [(10.0, 20.0), (20.0, 10.0), (None, 10.0), (10.0, None)])
def test_a_point_on_a_common_corner_takes_the_smaller_rate(
    rates: tuple[float | None, float | None],
) -> None:
    middle = WEST + CELL
    left = box(WEST, SOUTH, middle, SOUTH + CELL)
    right = box(middle, SOUTH, middle + CELL, SOUTH + CELL)
    (row,) = point_rates(a_map((left, rates[0]), (right, rates[1])), [(SOUTH, middle)])
    assert row["rate_l_ha"] == 10.0
    assert row["zone"] == f"zone{rates.index(10.0)}"

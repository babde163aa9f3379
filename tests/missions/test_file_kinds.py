"""Files as others write them: a sample of `make files`, a cell of the reference's tables a test."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box, unary_union

from tests.file_kinds import writers
from tests.file_kinds.ground import Ground
from tests.file_kinds.judge import judged
from tests.file_kinds.kind import SURE, Kind
from tests.file_kinds.kinds import COLUMNS, RULES
from tests.file_kinds.recorded import recorded


def sample() -> list[tuple[str, Kind, str]]:
    """Return every kind once, in one of its formats, so that all formats come in turn."""
    found = []
    for number, (rule, kind) in enumerate(
        (rule, kind) for rule, kinds in RULES.items() for kind in kinds
    ):
        names = [name for name in kind.writers() if name != "ISOXML"]
        found += [(rule, kind, names[number % len(names)])] if names else []
    return found


@pytest.mark.parametrize(
    ("rule", "kind", "name"), sample(), ids=lambda one: getattr(one, "name", None)
)
def test_file_of_this_kind_is_read_as_the_reference_says(
    rule: str, kind: Kind, name: str, tmp_path: Path
) -> None:
    found = judged(kind, name, kind.writers()[name], tmp_path)
    assert found.fine, str(found)
    assert found.outcome == recorded()[rule][kind.name][name], str(found)


def test_reference_says_nothing_of_kinds_that_are_gone() -> None:
    now = {rule: [kind.name for kind in kinds] for rule, kinds in RULES.items()}
    assert now == {rule: list(kinds) for rule, kinds in recorded().items()}


RATES = st.lists(st.decimals(0, 90, places=2).map(float), min_size=1, max_size=12)


@given(rates=RATES, name=st.sampled_from(COLUMNS), data=st.data())
@settings(max_examples=40)
def test_zones_of_any_number_and_rate_are_read_as_written(
    rates: list[float], name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    holed = data.draw(st.lists(st.booleans(), min_size=len(rates), max_size=len(rates)))
    wide = data.draw(st.integers(1, 4))
    polygons, truth = [], []
    for number, (rate, hole) in enumerate(zip(rates, holed, strict=True)):
        west, south = 24.0 * (number % wide), 24.0 * (number // wide)
        shell = box(west, south, west + 24.0, south + 24.0)
        island = box(west + 8.0, south + 8.0, west + 16.0, south + 16.0)
        polygons.append(Polygon(shell.exterior, [island.exterior]) if hole else shell)
        truth += [
            (west + 3.0, south + 5.0, rate),
            (west + 11.0, south + 12.0, None if hole else rate),
        ]
    ground = Ground(
        polygons=tuple(polygons), columns={"dose": rates}, truth=tuple(truth),
        area_m2=unary_union(polygons).area,
    )  # fmt: skip
    kind = Kind(name="drawn", make=lambda: ground, may=SURE)
    found = judged(kind, name, writers.VECTOR[name], tmp_path_factory.mktemp("drawn"))
    assert found.fine, str(found)


def test_the_judge_sees_a_wrong_rate(tmp_path: Path) -> None:
    wrong = RULES["Zones"][0].make()
    other = Ground(
        polygons=wrong.polygons, columns={"rate": [20.0, 26.0, 1.0]}, truth=wrong.truth,
        area_m2=wrong.area_m2,
    )  # fmt: skip
    kind = Kind(name="another", make=lambda: other)
    name, write = next(iter(writers.VECTOR.items()))
    found = judged(kind, name, write, tmp_path)
    assert found.outcome == "wrong"
    assert not found.fine

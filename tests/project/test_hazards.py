"""Every hazard of docs/hazards.md has a barrier and a test that exists."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "hazards.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")]
        for line in TEXT.splitlines() if re.match(r"\| H\d+ ", line)]  # fmt: skip
NAMED = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)`")


def test_each_hazard_has_a_number_of_its_own_a_severity_and_a_barrier() -> None:
    assert len(ROWS) >= 38
    assert len({row[0] for row in ROWS}) == len(ROWS)
    assert all(len(row) == 5 and row[2] in "ABC" and row[3] for row in ROWS)


def test_each_hazard_names_tests_that_exist() -> None:
    missing = []
    for number, _, _, _, tests in ROWS:
        found = NAMED.findall(tests)
        assert found, number
        for file, name in found:
            path = ROOT / file
            if not (path.exists() and re.search(rf"def {name}\(", path.read_text())):
                missing.append(f"{number}: {file}::{name}")
    assert not missing

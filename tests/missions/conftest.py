"""What several modules of plans are given."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.laid_out_once import laid_out_once


@pytest.fixture(scope="module")
def searched_briefly() -> Iterator[None]:
    """Search the shortest way between lines a tenth as long: for what holds of any order of lines.

    That search takes half of a plan's time. How good it is, `test_missions_tour.py`,
    `test_missions_small_fields.py` and the bench see.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("missions.worth.KICKS", 48_000)
        patch.setattr("missions.worth.KICKS_MIN", 2)
        patch.setattr("missions.worth.KICKS_MAX", 30)
        yield


@pytest.fixture(scope="module", name="laid_out_once")
def _laid_out_once() -> Iterator[None]:
    """Remember for a module which lines cover a field."""
    with laid_out_once():
        yield

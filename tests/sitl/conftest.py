"""What several modules of simulated flights are given."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sitl.anyang import demo_trajectory


@pytest.fixture
def one_pass() -> Iterator[None]:
    """Fly one pass of four over the example's field: for what does not depend on how many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sitl.anyang.PASS_COUNT", 1)
        demo_trajectory.cache_clear()
        yield
    demo_trajectory.cache_clear()

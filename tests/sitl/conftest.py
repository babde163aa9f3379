"""What several modules of simulated flights are given."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sitl.anyang import demo_trajectory


@pytest.fixture
def two_passes() -> Iterator[None]:
    """Fly there and back over the two middle rows of the example's plots, not over all four."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sitl.anyang.PASS_COUNT", 2)
        demo_trajectory.cache_clear()
        yield
    demo_trajectory.cache_clear()


@pytest.fixture
def not_compared() -> Iterator[None]:
    """Fly no second flight with perfect knowledge: for what is not asked of the comparison."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sitl.fly._perfect", lambda *_: None)
        yield

"""A chip for each test, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.gpio.sim import SimChip, why_not

LABEL = "pinctrl-vrspray"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a simulated chip where the kernel makes none."""
    needy = [item for item in items if item.get_closest_marker("needs_gpiosim")]
    reason = why_not() if needy else None
    if reason is None:
        return
    for item in needy:
        item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture
def chip() -> Iterator[SimChip]:
    """Yield a chip of 32 lines."""
    chip = SimChip(LABEL)
    yield chip
    chip.remove()

"""Lines laid over a field once, for tests that ask something else of the same field again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from types import FunctionType
from typing import Any

import numpy as np
import pytest
from shapely.geometry.base import BaseGeometry

from missions import layouts

USERS = ("missions.planner.spray_lines", "missions.make.flown.spray_lines")


@contextmanager
def laid_out_once() -> Iterator[None]:
    """Remember, for as long as the block lasts, which lines cover a field.

    Laying them takes most of a second, and is the same for the same field and settings:
    `test_missions_plan.py` is about that.
    """
    found: dict[object, Any] = {}

    def remembered(*given: object) -> Any:
        key = key_of(given)
        if key not in found:
            found[key] = layouts.spray_lines(*given)  # type: ignore[arg-type]
        lines, course_deg = found[key]
        return lines.copy(), course_deg

    with pytest.MonkeyPatch.context() as patch:
        for each in USERS:
            patch.setattr(each, remembered)
        yield


def key_of(value: Any) -> object:
    """Return what is equal exactly where two values are, to the bit."""
    if isinstance(value, BaseGeometry):
        return value.wkb
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if is_dataclass(value):
        given = (each.name for each in fields(value) if each.init)
        return type(value), tuple(key_of(getattr(value, name)) for name in given)
    if isinstance(value, tuple | list):
        return type(value), tuple(map(key_of, value))
    if isinstance(value, dict):
        return tuple((name, key_of(each)) for name, each in value.items())
    assert value is None or isinstance(value, bool | int | float | str | FunctionType), value
    return value

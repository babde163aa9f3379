"""Charts: values lie where the axes say, and ticks are round."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ImageColor

from analysis.wsp.cli import Axes, Canvas, ticks

BLUE, RED = "#4477aa", "#cc3311"


def axes() -> Axes:
    return Axes(
        canvas=Canvas(200, 150),
        place=(60.0, 10.0, 160.0, 110.0),
        x_range=(0.0, 10.0),
        y_range=(0.0, 50.0),
    )


def test_values_lie_where_the_axes_say() -> None:
    chart = axes()
    chart.bar(5.0, 25.0, BLUE)
    chart.level(40.0, RED, dashed=False)
    chart.finish("card", "coverage [%]")
    picture = chart.canvas.picture()
    assert picture.size == (200, 150)
    assert chart.at(5.0, 25.0) == (110.0, 60.0)
    assert picture.getpixel((110, 62)) == ImageColor.getrgb(BLUE)
    assert picture.getpixel((110, 57)) == picture.getpixel((118, 80)) == (255, 255, 255)
    red, green, _ = picture.getpixel((80, 30))  # type: ignore[misc]
    assert red > green + 50


def test_a_legend_names_what_was_drawn() -> None:
    chart = axes()
    for k, style in enumerate(("bar", "line", "dashes")):
        chart.name(f"part {k}", BLUE, style=style)
    chart.legend((70.0, 20.0))
    picture = chart.canvas.picture()
    for k in range(3):
        assert picture.getpixel((73, 20 + 20 * k)) != (255, 255, 255)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_lie_within_and_are_neither_few_nor_many(low: float, span: float) -> None:
    found = [value for value, _ in ticks(low, low + span)]
    assert 3 <= len(found) <= 10
    assert found[0] >= low - 1e-6 * span
    assert found[-1] <= low + span + 1e-6 * span


@pytest.mark.parametrize(("high", "texts"), [(3.0, ["0", "1", "2", "3"]), (0.5, ["0"])])
def test_cards_are_numbered_by_whole_numbers(high: float, texts: list[str]) -> None:
    assert [text for _, text in ticks(0.0, high, least_step=1.0)] == texts

"""What is measured in time, before anything runs beside it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from tests.bench.arrival import arrivals
from tests.bench.figures import Figure
from tests.bench.gpio_edges import gpio_edges
from tests.bench.loading import loading, ragged, raster
from tests.bench.lookup import cell_lookup, lookup_growth, lookups
from tests.bench.realtime import times_real_time
from tests.bench.steps import growth, large_field, small_field

TIMINGS = "Times"


def core_times(*, seed: int, is_quick: bool) -> list[Figure]:
    """Return what a step of the core takes."""
    zones = (100, 10_000) if is_quick else (100, 1_000, 10_000, 100_000)
    return _rows(
        [
            small_field(seed=seed, repeats=1 if is_quick else 3),
            large_field(seed=seed, length_m=300.0 if is_quick else 900.0),
            growth(seed=seed, zones=zones),
        ]
    )


def map_times(*, seed: int, is_quick: bool) -> list[Figure]:
    """Return what look-ups, the simulation and loading a map take."""
    figures = lookups(seed=seed)
    figures.append(lookup_growth(seed=seed, zones=(100, 10_000 if is_quick else 100_000)))
    figures.append(cell_lookup(seed=seed))
    figures.append(times_real_time(seed=seed, repeats=2 if is_quick else 4))
    figures.append(loading(seed=seed, repeats=1 if is_quick else 3))
    figures += ragged(seed=seed, repeats=1 if is_quick else 3)
    return _rows(figures + raster(seed=seed, repeats=1 if is_quick else 3))


def arrival_times(*, seed: int, is_quick: bool) -> list[Figure]:
    """Return what passes from a message to the last order's bytes."""
    return _rows(arrivals(seed=seed, count=100 if is_quick else 400))


def edge_times(*, seed: int, is_quick: bool) -> list[Figure]:
    """Return how late the edges of the valve engine are, and what it costs."""
    return _rows(gpio_edges(seed=seed, is_quick=is_quick))


def _rows(figures: Iterable[Figure]) -> list[Figure]:
    """Return the figures in the page's section; those with a target are lines of its summary."""
    return [
        replace(figure, section=TIMINGS, row=figure.what if figure.target is not None else "")
        for figure in figures
    ]

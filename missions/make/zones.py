"""Zones that the sprayer can fly, from values at places: classes, rates, limits, and their price.

Merging whatever is too short with a neighbour depends on the order of the merges and leaves litres
lying. Along one pass the best answer can be found: of all ways to cut it into runs of one rate,
each long enough, the one that misapplies least, by dynamic programming in one sweep.

Each thing that makes the map differ from what the data ask for is a step of its own, with the
ground and the litres that it moves: smoothing, what nozzles deliver, rates too close to be worth a
change, and the length that a change takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.errors import PlanError
from missions.make.classes import Method, classify
from missions.make.passes import Passes, Places
from missions.maps.local import polygons_of
from missions.maps.model import MapCells, MapZone

# -------------------------------------------------------------------- the best zones along one pass

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Labels = NDArray[np.int16]

NONE = -1
# Passes that are worked out together: more take more memory, and no less time.
TOGETHER = 64
# A run that is short of its least length by a rounding is not short.
SLACK = 1e-9


def settled(cost: Floats, length_m: Floats, least_m: float) -> Labels:
    """Return the zone of every cell (passes, cells); NONE where nothing is sprayed.

    Args:
        cost: (passes, cells, zones), what a cell would misapply with the rate of each zone.
        length_m: (passes, cells), how much of each cell is field along the pass; 0 parts a pass.
        least_m: how long a run of one zone must be. A stretch of field that is shorter is one run.

    >>> cost = np.array([[[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]])
    >>> settled(cost, np.ones((1, 4)), 1.0).tolist(), settled(cost, np.ones((1, 4)), 2.0).tolist()
    ([[0, 1, 0, 0]], [[0, 0, 0, 0]])
    """
    labels = np.full(length_m.shape, NONE, dtype=np.int16)
    pieces = stretches(length_m > 0.0)
    # Of like length together, so that few wait for the longest.
    pieces = pieces[np.argsort(pieces[:, 2] - pieces[:, 1], kind="stable")]
    for first in range(0, len(pieces), TOGETHER):
        some = pieces[first : first + TOGETHER]
        size = int((some[:, 2] - some[:, 1]).max())
        costs = np.zeros((len(some), size, cost.shape[2]))
        lengths = np.zeros((len(some), size))
        for row, (number, start, end) in enumerate(some.tolist()):
            costs[row, : end - start] = cost[number, start:end]
            lengths[row, : end - start] = length_m[number, start:end]
        found = _best(costs, lengths, some[:, 2] - some[:, 1], least_m)
        for row, (number, start, end) in enumerate(some.tolist()):
            labels[number, start:end] = found[row, : end - start]
    return labels


def stretches(there: NDArray[np.bool_]) -> Ints:
    """Return rows (pass, start, end) of cells that follow each other.

    >>> stretches(np.array([[True, True, False, True]])).tolist()
    [[0, 0, 2], [0, 3, 4]]
    """
    edges = np.diff(there.astype(np.int8), axis=1, prepend=0, append=0)
    number, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    return np.column_stack([number, start, end])


def _best(cost: Floats, length_m: Floats, sizes: Ints, least_m: float) -> Labels:
    """Return the zones of stretches (rows), whose cells behind their size are padding."""
    rows, size, zones = cost.shape
    every = np.arange(rows)
    done = np.concatenate([np.zeros((rows, 1, zones)), np.cumsum(cost, axis=1)], axis=1)
    reached = np.concatenate([np.zeros((rows, 1)), np.cumsum(length_m, axis=1)], axis=1)
    best = np.full((rows, size + 1), np.inf)
    best[:, 0] = 0.0
    zone_at = np.zeros((rows, size + 1), dtype=np.int16)
    start_at = np.zeros((rows, size + 1), dtype=np.int32)
    # The last start that is far enough back, and for each zone the best of all before it.
    last = np.full(rows, -1)
    cheapest = np.full((rows, zones), np.inf)
    begun = np.zeros((rows, zones), dtype=np.int32)
    for end in range(1, size + 1):
        while True:
            far = reached[every, last + 1] <= reached[:, end] - least_m + SLACK
            far &= last + 1 < end
            if not far.any():
                break
            last[far] += 1
            at = last[far]
            offered = best[far, at, None] - done[far, at]
            better = offered < cheapest[far]
            cheapest[far] = np.where(better, offered, cheapest[far])
            begun[far] = np.where(better, at[:, None], begun[far])
        sums = cheapest + done[:, end]
        zone = np.argmin(sums, axis=1)
        best[:, end] = sums[every, zone]
        zone_at[:, end] = zone
        start_at[:, end] = begun[every, zone]
    labels = np.full((rows, size), NONE, dtype=np.int16)
    for row in range(rows):
        end = int(sizes[row])
        if not np.isfinite(best[row, end]):
            labels[row, :end] = np.argmin(done[row, end])
        while end > 0 and np.isfinite(best[row, end]):
            start = int(start_at[row, end])
            labels[row, start:end] = zone_at[row, end]
            end = start
    return labels


# --------------------------------------------------------------------------------- zones of a field

# A run of zones is found in steps of this share of its least length.
STEPS_A_RUN = 8
# Edges of zones are straight in metres; in degrees they are, to a millimetre, for so long.
EDGE_MAX_M = 100.0
# Less is a sliver between a band and the border, and goes to its neighbour.
SMALL_M2 = 1.0
# What rounding leaves between two polygons that meet, and the grid on which their corners lie.
NOTHING_M2, GRID_M = 1e-3, 1e-4
# Rates are written with two decimals: a hundredth of a litre is below any nozzle.
DECIMALS = 2
# The search for the factor that meets a total of litres ends well below a millilitre.
ROUNDS = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What the grower wants: so many zones, and their rates.

    Args:
        rates_l_ha: of each zone, the lowest values first; else `law`.
        law: (value, rate) points with straight lines between, level beyond the ends.
        litres_max: in all; rates are lowered together until it is met.
        smooth_m: side of the square in which the most common zone holds; 0 for none.
        step_percent: rates closer than this become one.
    """

    count: int
    method: Method
    rates_l_ha: tuple[float, ...] = ()
    law: tuple[tuple[float, float], ...] = ()
    litres_max: float | None = None
    smooth_m: float = 0.0
    step_percent: float = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What the sprayer can follow: runs of `least_m`, and rates from `low_l_ha` to `high_l_ha`."""

    least_m: float
    low_l_ha: float
    high_l_ha: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What one step has changed: ground with another rate than before it, and litres.

    `moved_l` counts each litre that is sprayed elsewhere, more or less. `variance_kept_percent` is
    how much of the data's own differences in rate is left after it.
    """

    name: str
    changed_ha: float
    moved_l: float
    litres: float
    variance_kept_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Zones, and what became of the data on the way to them.

    `bands` has the zone of every step along every pass, NONE outside of the field. `became` has
    the rates that were asked for and are not what they became.
    """

    rates_l_ha: tuple[float, ...]
    became: tuple[tuple[float, float], ...]
    breaks: tuple[float, ...]
    means: tuple[float, ...]
    areas_ha: tuple[float, ...]
    bands: Labels
    step_m: float
    places: Places
    steps: tuple[Step, ...]
    ideal_l: float
    litres: float
    misapplied_l: float
    short_ha: float
    notes: tuple[str, ...]

    @property
    def misapplied_percent(self) -> float:
        """Return what lies elsewhere than the data ask for, of what they ask for."""
        return 100.0 * self.misapplied_l / self.ideal_l if self.ideal_l > 0.0 else 0.0


def make_zones(layers: Floats, places: Places, wish: Wish, limits: Limits | None) -> Made:
    """Return the zones of values (layers, places); without limits as the data have them.

    Raises:
        PlanError: where no such zones can be.
    """
    work = _Work(places, limits)
    classes = classify(layers, wish.count, wish.method)
    count = int(classes.labels.max()) + 1
    means = work.means(layers[0], classes.labels, count)
    ideal, rates = _ideal(layers[0], classes.labels, means, wish, work)
    asked, scale = rates, _scale(work, ideal, wish.litres_max)
    ideal, rates = ideal * scale, rates * scale
    if not work.litres(ideal) > 0.0:
        raise PlanError("all rates are zero: nothing would be sprayed; give others with --rates")
    work.begin(ideal)
    labels, notes = classes.labels, []
    if scale < 1.0:
        notes.append(f"rates lowered to {100 * scale:.1f} % to meet the total of litres")
    if count < wish.count:
        notes.append(f"{count} zones: the values have no more classes")
    work.step("zones", rates[labels])
    target = ideal
    if wish.smooth_m > 0.0:
        labels = _majority(labels, places, count, wish.smooth_m)
        work.step("smoothing", rates[labels])
        target = rates[labels]
    classes_left, places_of = np.unique(labels, return_index=True)
    if limits is not None:
        rates, labels, means = _delivered(work, rates, labels, means, wish, limits)
    every, bands, step_m = work.along(labels, rates, target)
    if limits is not None:
        # Zones can have grown: what is in the tank is not more.
        rates = _within(work, rates, every, wish.litres_max, limits)
        work.step("length and width", rates[every])
    work.step("rounding", rounded(rates, limits)[every])
    rates = rounded(rates, limits)
    final = rates[every]
    pairs = zip(asked[classes_left].tolist(), rates[labels[places_of]].tolist(), strict=True)
    areas_m2 = work.ground_m2(every, len(rates))
    return Made(
        rates_l_ha=tuple(rates.tolist()),
        became=tuple(pair for pair in pairs if abs(pair[0] - pair[1]) > 10.0**-DECIMALS),
        breaks=classes.breaks,
        means=tuple(means.tolist()),
        areas_ha=tuple((areas_m2 / 1e4).tolist()),
        bands=bands,
        step_m=step_m,
        places=places,
        steps=tuple(work.steps),
        ideal_l=work.litres(ideal),
        litres=work.litres(final),
        misapplied_l=work.litres(np.abs(final - ideal)),
        short_ha=_short_ha(bands, work),
        notes=tuple(notes),
    )


class _Work:
    """Rates at places on the way from data to zones, and what each step has cost."""

    def __init__(self, places: Places, limits: Limits | None) -> None:
        self.places, self.limits = places, limits
        self.area_m2 = places.area_m2
        self.steps: list[Step] = []

    def litres(self, rates: Floats) -> float:
        return float((rates * self.area_m2).sum()) / 1e4

    def ground_m2(self, labels: Labels, count: int) -> Floats:
        """Return the ground of every zone."""
        return np.bincount(labels, weights=self.area_m2, minlength=count).astype(np.float64)

    def means(self, values: Floats, labels: Labels, count: int) -> Floats:
        """Return the mean of values by zone, over the ground."""
        area = self.ground_m2(labels, count)
        sums = np.bincount(labels, weights=self.area_m2 * values, minlength=count)
        result: Floats = sums / np.maximum(area, 1e-9)
        return result

    def begin(self, ideal: Floats) -> None:
        self.ideal = self.now = ideal
        mean = self.litres(ideal) * 1e4 / self.area_m2.sum()
        self.variance = float((self.area_m2 * (ideal - mean) ** 2).sum())

    def step(self, name: str, rates: Floats) -> None:
        """Account for new rates, where they differ from those before."""
        change = np.abs(rates - self.now)
        moved_l = self.litres(change)
        self.now = rates
        if not moved_l > 0.0:
            return
        lost = float((self.area_m2 * (rates - self.ideal) ** 2).sum())
        kept = 1.0 - lost / self.variance if self.variance > 0.0 else 1.0
        self.steps.append(
            Step(
                name=name,
                changed_ha=float(self.area_m2[change > 1e-9].sum()) / 1e4,
                moved_l=moved_l,
                litres=self.litres(rates),
                variance_kept_percent=100.0 * max(kept, 0.0),
            )
        )

    def along(self, labels: Labels, rates: Floats, target: Floats) -> tuple[Labels, Labels, float]:
        """Return the zone of every place and of every step along the passes, and the step [m]."""
        places = self.places
        if self.limits is None:
            return labels, places.spread(labels, NONE), places.step_m
        together = max(int(self.limits.least_m / STEPS_A_RUN / places.step_m), 1)
        columns = -(-places.columns // together)
        cell = (places.row // places.rows) * columns + places.column // together
        shape, size = (places.bands, columns), places.bands * columns
        cost = np.empty((*shape, len(rates)))
        for zone, rate in enumerate(rates.tolist()):
            litres = np.abs(rate - target) * self.area_m2
            cost[..., zone] = np.bincount(cell, weights=litres, minlength=size).reshape(shape)
        ground = np.bincount(cell, weights=self.area_m2, minlength=size).reshape(shape)
        length_m = ground / np.diff(places.passes.edges_m)[:, None]
        bands = settled(cost, length_m, self.limits.least_m)
        self.length_m = length_m
        return bands.reshape(-1)[cell], bands, together * places.step_m


def _ideal(
    values: Floats, labels: Labels, means: Floats, wish: Wish, work: _Work
) -> tuple[Floats, Floats]:
    """Return the rates that the data ask for, at every place and for every zone."""
    count = len(means)
    if wish.law:
        at, rate = np.array(wish.law).T
        ideal = np.interp(values, at, rate)
        return ideal, work.means(ideal, labels, count)
    if len(wish.rates_l_ha) != count:
        raise PlanError(
            f"{len(wish.rates_l_ha)} rates for {count} zones: give one for each with --rates, the "
            "zone of the lowest values first"
        )
    rates = np.array(wish.rates_l_ha, dtype=np.float64)
    return rates[labels], rates


def _scale(work: _Work, ideal: Floats, litres_max: float | None) -> float:
    asked = work.litres(ideal)
    return 1.0 if litres_max is None or asked <= litres_max else litres_max / asked


def _majority(labels: Labels, places: Places, count: int, side_m: float) -> Labels:
    """Return the most common zone in a square around every place."""
    from scipy.ndimage import uniform_filter

    size = (
        max(round(side_m / float(places.row_m.mean())), 1) | 1,
        max(round(side_m / places.step_m), 1) | 1,
    )
    most, best = np.full(len(labels), -1.0), labels.copy()
    for zone in range(count):
        share = places.spread((labels == zone).astype(np.float32), 0.0)
        here = uniform_filter(share, size=size, mode="constant")[places.row, places.column]
        # Where two are as common, the place keeps its own.
        more = here > most + np.where(labels == best, 1e-6, 0.0)
        more |= (labels == zone) & (here >= most - 1e-6)
        most[more], best[more] = here[more], zone
    return best


def _delivered(
    work: _Work, rates: Floats, labels: Labels, means: Floats, wish: Wish, limits: Limits
) -> tuple[Floats, Labels, Floats]:
    """Return zones whose rates the nozzles deliver, and differ enough to be worth a change."""
    area = work.ground_m2(labels, len(rates))
    rates = _meeting(rates, area, wish.litres_max, limits)
    work.step("nozzles", rates[labels])
    rates, labels, means = _apart(rates, labels, means, area, wish.step_percent)
    work.step("steps of rate", rates[labels])
    return rates, labels, means


def clipped(rates: Floats, limits: Limits) -> Floats:
    """Return rates within what the nozzles deliver; a rate of 0 closes them.

    >>> limits = Limits(least_m=1.0, low_l_ha=8.0, high_l_ha=30.0)
    >>> clipped(np.array([0.0, 5.0, 20.0, 40.0]), limits).tolist()
    [0.0, 8.0, 20.0, 30.0]
    """
    return np.where(rates > 0.0, np.clip(rates, limits.low_l_ha, limits.high_l_ha), 0.0)


def _meeting(rates: Floats, area_m2: Floats, litres_max: float | None, limits: Limits) -> Floats:
    """Return rates that nozzles deliver and the tank holds, lowered by one factor."""
    first = clipped(rates, limits)
    if litres_max is None or first @ area_m2 <= litres_max * 1e4:
        return first
    least_l = float(clipped(np.where(rates > 0.0, 1e-9, 0.0), limits) @ area_m2) / 1e4
    if least_l > litres_max:
        raise PlanError(
            f"--litres-max {litres_max:g}: at {limits.low_l_ha:.2f} L/ha, the least that the "
            f"nozzles deliver at this speed, the zones take {least_l:.1f} L; fly faster, or give "
            "a zone the rate 0"
        )
    low, high = 0.0, 1.0
    for _ in range(ROUNDS):
        middle = (low + high) / 2.0
        fits = clipped(rates * middle, limits) @ area_m2 <= litres_max * 1e4
        low, high = (middle, high) if fits else (low, middle)
    return clipped(rates * low if low > 0.0 else rates * 1e-12, limits)


def _apart(
    rates: Floats, labels: Labels, means: Floats, area_m2: Floats, percent: float
) -> tuple[Floats, Labels, Floats]:
    """Join zones whose rates differ by less than a share of the larger, the closest first."""
    groups = [[index] for index in np.argsort(rates, kind="stable").tolist()]
    joint = [float(rates[group[0]]) for group in groups]
    while len(groups) > 1:
        gaps = [(high - low) / high if high > 0.0 else 0.0 for low, high in pairwise(joint)]
        at = int(np.argmin(gaps))
        if gaps[at] >= percent / 100.0:
            break
        group = groups[at] + groups[at + 1]
        weight = np.maximum(area_m2[group], 1e-9)
        groups[at : at + 2] = [group]
        joint[at : at + 2] = [float(rates[group] @ weight / weight.sum())]
    # In the order of their values again, as they were before.
    order = sorted(range(len(groups)), key=lambda one: min(groups[one]))
    number = np.empty(len(rates), dtype=np.int16)
    for new, old in enumerate(order):
        number[groups[old]] = new
    weights = [np.maximum(area_m2[groups[old]], 1e-9) for old in order]
    mean = [
        float(means[groups[old]] @ weight / weight.sum())
        for old, weight in zip(order, weights, strict=True)
    ]
    return np.array([joint[old] for old in order]), number[labels], np.array(mean)


def _within(
    work: _Work, rates: Floats, every: Labels, litres_max: float | None, limits: Limits
) -> Floats:
    area = work.ground_m2(every, len(rates))
    return _meeting(rates, area, litres_max, limits)


def rounded(rates: Floats, limits: Limits | None) -> Floats:
    """Return rates with two decimals, downwards where a total or a nozzle would be passed."""
    step = 10.0**-DECIMALS
    found = np.floor(rates / step + 1e-6) * step
    if limits is not None:
        low = np.ceil(limits.low_l_ha / step - 1e-6) * step
        found = np.where((rates > 0.0) & (found < limits.low_l_ha), low, found)
    return np.round(found, DECIMALS)


def _short_ha(bands: Labels, work: _Work) -> float:
    """Return the ground on stretches of field that are themselves too short for one run."""
    if work.limits is None:
        return 0.0
    width_m = np.diff(work.places.passes.edges_m)
    total_m2 = 0.0
    for number, start, end in stretches(bands != NONE).tolist():
        length_m = float(work.length_m[number, start:end].sum())
        if length_m < work.limits.least_m - 1e-6:
            total_m2 += length_m * float(width_m[number])
    return total_m2 / 1e4


# From runs along the passes to polygons.


def polygons(
    made: Made, ground: BaseGeometry, frame: LocalFrame, *, strip_m: float
) -> list[MapZone]:
    """Return the zones in longitude and latitude, cut at the field's border.

    What the border leaves of a zone, narrower than the strip of one valve, goes to its neighbour.
    """
    passes, places = made.places.passes, made.places
    edges = passes.edges_m
    row, start, zone, end = _runs(made.bands)
    # Beyond the field's border nothing is meant: the ends of a pass reach over it.
    boxes = shapely.box(
        places.start_m + start * made.step_m, edges[row], places.start_m + end * made.step_m,
        edges[row + 1],
    )  # fmt: skip
    turned = shapely.transform(ground, passes.turned)
    found = []
    taken: BaseGeometry = MultiPolygon()
    for number in np.unique(zone).tolist():
        area = shapely.union_all(boxes[zone == number])
        parts = polygons_of(shapely.intersection(area, turned))
        found.append((number, MultiPolygon([one for one in parts if _is_ground(one, strip_m)])))
        taken = shapely.union(taken, found[-1][1])
    beyond = polygons_of(shapely.difference(turned, taken))
    rest = [one for one in beyond if one.area >= NOTHING_M2]
    return _with_rest(made, found, rest, passes, frame)


def _is_ground(part: Polygon, strip_m: float) -> bool:
    """Tell whether a part of a zone is as wide on average as the strip of one valve."""
    along_m = part.bounds[2] - part.bounds[0]
    return bool(part.area >= max(SMALL_M2, strip_m * along_m))


def cells(made: Made, frame: LocalFrame) -> MapCells:
    """Return zones without limits as cells, one for each place."""
    places, passes = made.places, made.places.passes
    width_m = float(places.row_m[0])
    corner, column, row = passes.back(
        np.array(
            [
                [places.start_m, passes.edges_m[0]],
                [places.start_m + places.step_m, passes.edges_m[0]],
                [places.start_m, passes.edges_m[0] + width_m],
            ]
        )
    )
    (a, d), (b, e) = column - corner, row - corner
    rates = np.append(np.array(made.rates_l_ha), np.nan)[made.bands]
    transform = (float(a), float(b), float(corner[0]), float(d), float(e), float(corner[1]))
    return MapCells(rates_l_ha=rates, transform=transform, crs=frame.crs)


def _runs(bands: Labels) -> tuple[NDArray[np.int64], ...]:
    """Return row, start, zone and end of all runs of one zone."""
    changes = np.diff(bands.astype(np.int32), axis=1, prepend=NONE - 1) != 0
    row, start = np.nonzero(changes)
    end = np.append(start[1:], 0)
    last = np.append(row[1:] != row[:-1], True)
    end[last] = bands.shape[1]
    zone = bands[row, start].astype(np.int64)
    some = zone != NONE
    return row[some], start[some], zone[some], end[some]


def _with_rest(
    made: Made,
    found: Sequence[tuple[int, BaseGeometry]],
    rest: Sequence[BaseGeometry],
    passes: Passes,
    frame: LocalFrame,
) -> list[MapZone]:
    """Return the zones, each with the slivers along the border that no place stands for."""
    numbers = [number for number, _ in found]
    parts = {number: [area] for number, area in found}
    if rest:
        areas = np.array([area for _, area in found], dtype=object)
        for piece in rest:
            shared = shapely.length(shapely.intersection(shapely.boundary(areas), piece))
            nearest = shapely.distance(areas, piece)
            parts[numbers[int(np.lexsort((nearest, -shared))[0])]].append(piece)
    zones = []
    for number in numbers:
        united = shapely.union_all(np.array(parts[number], dtype=object))
        area = MultiPolygon(polygons_of(shapely.set_precision(united, GRID_M)))
        if area.is_empty:
            continue
        local = shapely.transform(shapely.segmentize(area, EDGE_MAX_M), passes.back)

        def there(points: Floats) -> Floats:
            latitude, longitude = frame.to_geographic_all(
                points[:, 0].tolist(), points[:, 1].tolist()
            )
            return np.column_stack([longitude, latitude])

        zones.append(
            MapZone(
                name=f"zone {number + 1}",
                geometry=shapely.transform(local, there),
                rate_l_ha=float(made.rates_l_ha[number]),
            )
        )
    return zones

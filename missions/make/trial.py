"""`vrspray make trial`: a randomised trial whose plots the sprayer can fly, and where they lie.

A plot is whole passes wide. Along them it begins and ends with ground on which the rate settles,
flown from either side; only what lies between counts (the inner part, which is harvested). As
strips the plots run as far as the field goes, side by side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
import typer
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from companion.atomic_write import write_atomically
from companion.cli.answer import (
    problem_object,
)
from companion.map_formats import geojson_feature, geojson_text
from companion.wording import counted, refuse_existing
from missions.errors import PlanError
from missions.make.flown import (
    MARGIN,
    FlownField,
    Making,
    Margin,
    check_rate,
    limits_of,
    making,
    numbers,
    problems_of,
)
from missions.maps.local import polygons_of
from missions.maps.model import MapFile, MapZone, digest, not_written, read_bytes
from missions.strips import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """What the trial compares, and how large its plots are.

    Args:
        rates_l_ha: of the treatments; no two alike.
        plot_m: length of a plot along the passes; None for strips as long as the field.
        wide: passes a plot.
        settle_m: on which the rate settles, at both ends of each plot.
        guard_m: beside the inner part, where the next plot's deposit reaches over.
    """

    rates_l_ha: tuple[float, ...]
    blocks: int
    plot_m: float | None
    wide: int
    settle_m: float
    guard_m: float
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """One plot, by along and right of the passes."""

    block: int
    number: int
    treatment: int
    start_m: float
    end_m: float
    left_m: float
    right_m: float

    def area(self) -> Polygon:
        """Return the whole plot."""
        return shapely.box(self.start_m, self.left_m, self.end_m, self.right_m)

    def inner(self, design: Design) -> Polygon:
        """Return what counts of it."""
        return shapely.box(
            self.start_m + design.settle_m, self.left_m + design.guard_m,
            self.end_m - design.settle_m, self.right_m - design.guard_m,
        )  # fmt: skip


def lay_out(ground: BaseGeometry, edges_m: Floats, design: Design) -> list[Plot]:
    """Return the plots on ground (along, right) whose passes lie between edges.

    Raises:
        PlanError: where they do not fit, with how many would.
    """
    slots = max((_slots(ground, edges_m[first:], design) for first in range(design.wide)), key=len)
    if len(slots) < design.blocks:
        length = "" if design.plot_m is None else f" {design.plot_m:g} m long and"
        raise PlanError(
            f"{design.blocks} blocks of {len(design.rates_l_ha)} plots,{length} "
            f"{counted(design.wide, 'pass')} wide, do not fit into the field: {len(slots)} would; "
            "lower --blocks, --plot-m, --passes or --headland-m"
        )
    draw = np.random.default_rng(design.seed)
    found: list[Plot] = []
    for block, places in enumerate(slots[: design.blocks], 1):
        order = draw.permutation(len(design.rates_l_ha)).tolist()
        for (start, end, left, right), treatment in zip(places, order, strict=True):
            found.append(
                Plot(
                    block=block, number=len(found) + 1, treatment=treatment, start_m=start,
                    end_m=end, left_m=left, right_m=right,
                )
            )  # fmt: skip
    return found


Place = tuple[float, float, float, float]


def _slots(ground: BaseGeometry, edges_m: Floats, design: Design) -> list[list[Place]]:
    """Return room for blocks, each with the places of its plots; next to the middle first."""
    count = len(design.rates_l_ha)
    groups = [
        (float(edges_m[at]), float(edges_m[at + design.wide]))
        for at in range(0, len(edges_m) - design.wide, design.wide)
    ]
    free = [_free(ground, left, right) for left, right in groups]
    found: list[list[Place]] = []
    if design.plot_m is None:
        longest = [max(one, key=lambda span: span[1] - span[0], default=None) for one in free]
        row: list[Place] = []
        for (left, right), span in zip(groups, longest, strict=True):
            if span is None or span[1] - span[0] < 3.0 * design.settle_m:
                row = []
                continue
            row.append((*span, left, right))
            if len(row) == count:
                found.append(row)
                row = []
    else:
        whole_m = count * design.plot_m
        for (left, right), spans in zip(groups, free, strict=True):
            for start, end in spans:
                room = int((end - start + 1e-9) // whole_m)
                first = start + (end - start - room * whole_m) / 2.0
                found += [
                    [
                        (first + (block * count + at) * design.plot_m,
                         first + (block * count + at + 1) * design.plot_m, left, right)
                        for at in range(count)
                    ]
                    for block in range(room)
                ]  # fmt: skip
    centre = shapely.centroid(ground)

    def away(block: Sequence[Place]) -> float:
        places = np.array(block)
        along = 0.5 * (places[:, 0].min() + places[:, 1].max()) - centre.x
        right = 0.5 * (places[:, 2].min() + places[:, 3].max()) - centre.y
        return float(np.hypot(along, right))

    return sorted(found, key=away)


def _free(ground: BaseGeometry, left_m: float, right_m: float) -> list[tuple[float, float]]:
    """Return from where to where a band lies in the ground with its whole width.

    >>> _free(shapely.Polygon([(0, 0), (10, 0), (8, 2), (0, 2)]), 0.0, 2.0)
    [(0.0, 8.0)]
    """
    start, _, end, _ = ground.bounds
    band = shapely.box(start, left_m, end, right_m)
    blocked = sorted(
        (one.bounds[0], one.bounds[2])
        for one in polygons_of(shapely.difference(band, ground))
        if one.area > 1e-6
    )
    found, at = [], start
    for low, high in [*blocked, (end, end)]:
        if low > at:
            found.append((at, low))
        at = max(at, high)
    return found


# -------------------------------------------------------------------------------------- the command

VERSION = 1
BLOCKS_MAX, TREATMENTS_MAX = 50, 20


@making
def trial(
    making: Making,
    rates: Annotated[str, typer.Option(metavar="R,R,...", help="L/ha of the treatments.")],
    rest: Annotated[
        float, typer.Option(metavar="R", help="L/ha on the ground around the plots.", min=0.0)
    ],
    check: Annotated[
        float | None,
        typer.Option(metavar="R", help="L/ha of a check plot in every block.", min=0.0),
    ] = None,
    blocks: Annotated[
        int, typer.Option(metavar="N", help="Repeats of all treatments.", min=2, max=BLOCKS_MAX)
    ] = 4,
    plot_m: Annotated[
        float,
        typer.Option(metavar="M", help="Length of a plot along the passes.", min=1.0, max=10_000.0),
    ] = 30.0,
    strips: Annotated[
        bool, typer.Option("--strips", help="Plots as long as the field, side by side.")
    ] = False,
    passes: Annotated[
        int, typer.Option(metavar="N", help="Width of a plot in passes.", min=1, max=20)
    ] = 1,
    guard_m: Annotated[
        float,
        typer.Option(
            metavar="M",
            help="Strip on both sides of a plot that is not harvested.",
            min=0.0,
            max=100.0,
        ),
    ] = 0.5,
    headland_m: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Kept off the border; default: one swath.", min=0.0, max=1000.0
        ),
    ] = None,
    margin: Margin = MARGIN,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Seed of the random order; it is recorded.", min=0)
    ] = 1,
) -> None:
    """Lay out a randomised trial that the sprayer can follow.

    Beside the map NAME.trial.geojson holds plots, inner parts, treatments, blocks and the seed,
    for `vrspray trial`, which evaluates the flight.

    Exit 0: made; 1: made, and the check of the map found errors; 2: refused.
    """
    config, target = making.config(), making.target
    record = target.with_name(f"{target.stem}.trial.geojson")
    refuse_existing(record, force=making.force)
    treatments = _treatments(rates, check)
    field = making.field(config, "swath")
    limits = limits_of(config, field.sprayer, margin)
    for rate in filter(None, (*treatments, rest)):
        check_rate(rate, limits, said=f"{rate:g} L/ha")
    if not strips and plot_m < 3.0 * limits.least_m:
        raise PlanError(
            f"--plot-m {plot_m:g}: rates take {limits.least_m:.2f} m to settle at each end of a "
            f"plot; give at least {3.0 * limits.least_m:.1f} m, or fly slower"
        )
    width_m = config.boom_table.width_m
    if passes * width_m <= 2.0 * guard_m:
        raise PlanError(f"--guard-m {guard_m:g}: nothing is left of {passes * width_m:g} m")
    design = Design(
        rates_l_ha=treatments, blocks=blocks, plot_m=None if strips else plot_m, wide=passes,
        settle_m=limits.least_m, guard_m=guard_m, seed=seed,
    )  # fmt: skip
    ground = shapely.buffer(
        field.turned(), -(width_m if headland_m is None else headland_m), join_style="mitre"
    )
    if ground.is_empty:
        raise PlanError("--headland-m: no ground is left within it; give a smaller one")
    plots = lay_out(ground, field.passes.edges_m, design)
    map_file = _map_file(plots, design, field, target, rest)
    problems = problems_of(map_file, config, field)
    files = making.written(map_file, config, field, problems, _names(plots, treatments))
    said = _said(design, field, rest, check=check is not None)
    text = geojson_text(_features(plots, design, field), trial=said)
    try:
        write_atomically(record, text.encode())
    except OSError as error:
        raise not_written(record, error) from None
    ok = not any(problem.severity == "error" for problem in problems)
    result = {
        "ok": ok,
        "files": [str(path) for path in (*files, record)],
        **said,
        "problems": [problem_object(problem) for problem in problems],
        "plots": [
            {"plot": plot.number, "block": plot.block, "rate_l_ha": treatments[plot.treatment]}
            for plot in plots
        ],
    }
    making.answer(result, _lines(result, plots, design))


def _names(plots: Sequence[Plot], rates_l_ha: Sequence[float]) -> dict[str, str]:
    """Return what is written on the plots of the picture, by what the map calls them."""
    return {
        f"plot {plot.number}": f"{plot.number}, block {plot.block}: "
        f"{rates_l_ha[plot.treatment]:g} L/ha"
        for plot in plots
    }


def _treatments(rates: str, check: float | None) -> tuple[float, ...]:
    given = ([] if check is None else [check]) + numbers(rates, "--rates")
    if len(set(given)) < max(len(given), 2):
        raise typer.BadParameter("a trial compares two different rates or more, none of them twice")
    if len(given) > TREATMENTS_MAX:
        raise typer.BadParameter(f"a trial has at most {TREATMENTS_MAX} treatments")
    return tuple(given)


def _map_file(
    plots: Sequence[Plot], design: Design, field: FlownField, target: Path, rest: float
) -> MapFile:
    areas = [plot.area() for plot in plots]
    around = shapely.difference(field.turned(), shapely.union_all(areas))
    zones = [
        MapZone(
            name=f"plot {plot.number}", geometry=field.degrees(area),
            rate_l_ha=design.rates_l_ha[plot.treatment],
        )
        for plot, area in zip(plots, areas, strict=True)
    ]  # fmt: skip
    zones.append(MapZone(name="rest", geometry=field.degrees(around), rate_l_ha=rest))
    return MapFile(
        path=target, format="made", crs="EPSG:4326", unit="L/ha", rate_field="rate",
        sha256=digest([read_bytes(field.boundary_file)]) if field.boundary_file.is_file() else "",
        boundary=field.boundary, zones=tuple(zones),
    )  # fmt: skip


def _said(design: Design, field: FlownField, rest_l_ha: float, *, check: bool) -> dict[str, Any]:
    """Return what was laid out, as the record and the answer have it."""
    return {
        "version": VERSION,
        "design": "strips" if design.plot_m is None else "plots",
        "treatments_l_ha": list(design.rates_l_ha),
        "check_l_ha": design.rates_l_ha[0] if check else None,
        "rest_l_ha": rest_l_ha,
        "blocks": design.blocks,
        "seed": design.seed,
        "course_deg": field.passes.angle_deg,
        "settle_m": design.settle_m,
        "guard_m": design.guard_m,
        "speed_m_s": field.sprayer.speed_m_s,
    }


def _features(plots: Sequence[Plot], design: Design, field: FlownField) -> Iterator[dict[str, Any]]:
    """Yield a feature for each plot and its inner part."""
    for plot in plots:
        for part, area in (("plot", plot.area()), ("inner", plot.inner(design))):
            said = {
                "plot": plot.number, "block": plot.block, "part": part,
                "rate_l_ha": design.rates_l_ha[plot.treatment],
            }  # fmt: skip
            yield geojson_feature(field.degrees(area), said)


def _lines(result: dict[str, Any], plots: Sequence[Plot], design: Design) -> list[str]:
    lines = [
        f"course {result['course_deg']:g} deg; {design.blocks} blocks of "
        f"{len(design.rates_l_ha)} {result['design']}, seed {design.seed}; the first and last "
        f"{design.settle_m:.2f} m of each settle and do not count"
    ]
    for block in range(1, design.blocks + 1):
        own = [plot for plot in plots if plot.block == block]
        shown = ", ".join(f"{plot.number}: {design.rates_l_ha[plot.treatment]:g}" for plot in own)
        lines.append(f"block {block}, {own[0].end_m - own[0].start_m:.1f} m each: {shown} L/ha")
    return [*lines, *(f"written: {name}" for name in result["files"])]

"""The field as it will be flown, what commands ask for it, and a made map from there to its file.

All that `vrspray make` makes has this in common: the passes that `vrspray plan` lays, what the
sprayer can follow on them, the checks of `map check`, and files, a flight map among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import shapely
import typer
from shapely import MultiPolygon
from shapely.geometry.base import BaseGeometry

from companion.assembly import flow_range
from companion.cli.answer import (
    REQUIRED,
    AsJson,
    Option,
    Overrides,
    answer,
    note_problems,
    with_options,
)
from companion.config import Config, load
from companion.config.tables import PrescriptionTable
from companion.core.frame import LocalFrame
from companion.core.nozzle import rate_for_flow
from companion.errors import ConfigError, Problem
from companion.flight_map import is_flight_map
from missions.errors import PlanError
from missions.layouts import spray_lines
from missions.make.passes import Passes, by_valve, passes_of
from missions.make.zones import EDGE_MAX_M, GRID_M, Limits
from missions.maps.cli.options import plan_of, sprayer_problems
from missions.maps.compiling import MapOrder, compile_map, write_flight_map
from missions.maps.convert.formats import write_map, writer_for
from missions.maps.lint import Sprayer, check_map
from missions.maps.local import polygons_of
from missions.maps.model import MapFile, check_folder, not_written
from missions.maps.registry import read_area
from missions.reading import Asked, Task, read_task
from missions.strips import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownField:
    """The field with its passes, and the sprayer on them."""

    boundary: MultiPolygon
    boundary_file: Path
    task: Task
    passes: Passes
    sprayer: Sprayer
    lines: Floats
    swath_m: float

    @property
    def frame(self) -> LocalFrame:
        """Return metres east and north of one origin."""
        return self.task.field.frame

    def turned(self) -> BaseGeometry:
        """Return the ground that may be sprayed, as the passes see it: (along, right)."""
        return shapely.transform(self.task.field.limit, self.passes.turned)

    def degrees(self, turned: BaseGeometry) -> MultiPolygon:
        """Return ground of (along, right) in longitude and latitude."""
        area = MultiPolygon(polygons_of(shapely.set_precision(turned, GRID_M)))
        local = shapely.transform(shapely.segmentize(area, EDGE_MAX_M), self.passes.back)

        def there(points: Floats) -> Floats:
            latitude, longitude = self.frame.to_geographic_all(
                points[:, 0].tolist(), points[:, 1].tolist()
            )
            return np.column_stack([longitude, latitude])

        found: MultiPolygon = shapely.transform(local, there)
        return found


def bounded(config: Config, boundary: Path | None) -> Config:
    """Return the configuration with the outline that the command line names."""
    if boundary is None:
        return config
    changes: dict[str, Any] = {"boundary": str(boundary.absolute())}
    table = config.prescription
    if table is None:
        changed = PrescriptionTable.model_validate({"file": "made", **changes})
    else:
        changed = table.model_copy(update=changes)
    return config.model_copy(update={"prescription": changed})


def _by_valve(passes: Passes, config: Config) -> Passes:
    """Return the bands of single valves, which only mean the same to and fro on an even boom."""
    valves = sorted((valve.right_m, valve.width_m) for valve in config.boom().valves)
    widths = [width_m for _, width_m in valves]
    if not np.allclose(widths, widths[::-1], atol=0.01):
        raise ConfigError(
            f"{config.path}: [[valve]] width_m: the boom's left half is not a mirror of its right "
            "one, so that zones as wide as a valve fit one direction alone; leave out --across"
        )
    return by_valve(passes, widths)


def flown_field(
    config: Config, no_spray: Sequence[Path], angle_deg: float | None, across: str
) -> FlownField:
    """Return the field with its passes, those that `vrspray plan` lays, as far from the border."""
    table = config.prescription
    path = None if table is None or table.boundary is None else config.resolve(table.boundary)
    if path is None:
        raise ConfigError(
            f"{config.path}: prescription.boundary: missing; where the field ends is not in the "
            "data, so name its outline there or with --boundary"
        )
    asked = Asked(field=path, rate_l_ha=1.0, no_spray=tuple(no_spray))
    task = read_task(asked, config, {"angle_deg": angle_deg})
    lines, course_deg = spray_lines(task.field, task.settings, task.settings.motion)
    if not len(lines):
        raise PlanError(f"{path}: no pass of {task.settings.swath_width_m:g} m fits into the field")
    sprayer = plan_of(config, None)[0].sprayer
    if sprayer is None:
        raise ConfigError(f"{config.path}: mission: missing; write at least swath_width_m, speed")
    passes = passes_of(lines, course_deg, task.field.limit, task.settings.swath_width_m)
    return FlownField(
        boundary=read_area(path, repairs=[]),
        boundary_file=path,
        task=task,
        passes=_by_valve(passes, config) if across == "valve" else passes,
        sprayer=replace(sprayer, angle_deg=course_deg),
        lines=lines,
        swath_m=task.settings.swath_width_m,
    )


def limits_of(config: Config, sprayer: Sprayer, margin: float) -> Limits:
    """Return how long a rate has to last, and the rates that nozzles and label allow."""
    width_m, speed = config.boom_table.width_m, sprayer.speed_m_s
    low, high = flow_range(config.nozzle_sets(), config.pwm_limits())
    most = config.rate_max_l_ha()
    least = None if config.label is None else config.label.rate_min_l_ha
    high_l_ha = rate_for_flow(high, speed, width_m)
    low_l_ha = rate_for_flow(low, speed, width_m)
    if most is not None and most < low_l_ha:
        raise ConfigError(
            f"{config.path}: rate_max_l_ha = {most:g} of product or limits file: below the "
            f"{low_l_ha:.2f} L/ha that the nozzles deliver at least at {speed:g} m/s; fly faster "
            "or fit smaller nozzles"
        )
    if least is not None and least > high_l_ha:
        raise ConfigError(
            f"{config.limits_table.file}: rate_min_l_ha = {least:g}: above the {high_l_ha:.2f} "
            f"L/ha that the nozzles deliver at most at {speed:g} m/s; fly slower or fit larger ones"
        )
    return Limits(
        least_m=margin * sprayer.length_min_m,
        low_l_ha=low_l_ha if least is None else max(low_l_ha, least),
        high_l_ha=high_l_ha if most is None else min(high_l_ha, most),
    )


def problems_of(map_file: MapFile, config: Config, field: FlownField) -> list[Problem]:
    """Return what `map check` says of the map, flown as it was made for."""
    plan, found = plan_of(config, None)
    plan = replace(plan, boundary=field.boundary, sprayer=field.sprayer)
    return [
        *check_map(map_file, overlap="error", plan=plan),
        *found,
        *sprayer_problems(config, map_file, plan),
    ]


def check_rate(rate_l_ha: float, limits: Limits, *, said: str) -> None:
    """Refuse a rate that the sprayer would not put down; `said` is how the user gave it."""
    if not limits.low_l_ha <= rate_l_ha <= limits.high_l_ha:
        raise PlanError(
            f"{said}: nozzles and label allow {limits.low_l_ha:.2f} to "
            f"{limits.high_l_ha:.2f} L/ha at the planned speed; change the rate or the speed"
        )


def numbers(text: str, option: str) -> list[float]:
    """Return the numbers of an option, with commas between."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(
            f"{option} takes numbers with commas between, not {text!r}"
        ) from None
    if not all(math.isfinite(one) for one in found):
        raise typer.BadParameter(f"{option} takes finite numbers, not {text!r}")
    return found


# ------------------------------------------------------------------------ arguments of the commands

# A zone or a plot is this much longer than a change takes: for wind, and for the aircraft's speed.
MARGIN = 1.5

Margin = Annotated[
    float,
    typer.Option(
        metavar="X", help="Safety factor on the length that a change takes.", min=1.0, max=20.0
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Making:
    """What every command that makes a map is asked, and what it does for all of them."""

    out: Path
    config_file: Path
    boundary: Path | None
    no_spray: list[Path] | None
    angle_deg: float | None
    png: Path | None
    format_name: str | None
    force: bool
    overrides: list[str] | None
    as_json: bool

    @property
    def target(self) -> Path:
        """Return the map that is written: beside a flight map, the one that it is compiled from."""
        if not is_flight_map(self.out):
            return self.out
        return self.out.with_name(self.out.name.removesuffix(".flightmap.gpkg") + ".gpkg")

    def config(self, *others: Path | None) -> Config:
        """Return the configuration of the flight; refuse what cannot be written."""
        config = bounded(load(self.config_file, overrides=self.overrides or ()), self.boundary)
        writer_for(self.target, self.format_name)
        for path in filter(None, (self.out, self.png, *others)):
            check_folder(path)
        return config

    def field(self, config: Config, across: str) -> FlownField:
        """Return the field with its passes."""
        return flown_field(config, self.no_spray or [], self.angle_deg, across)

    def written(
        self, map_file: MapFile, config: Config, field: FlownField, problems: Sequence[Problem],
        names: Mapping[str, str] | None = None,
    ) -> list[Path]:  # fmt: skip
        """Write the map, and beside it the flight map and the picture if they are asked for."""
        files = write_map(
            map_file, self.target, format=writer_for(self.target, self.format_name).name,
            force=self.force, flow_width_m=config.boom_table.width_m,
            flow_speed_m_s=field.sprayer.speed_m_s,
        )  # fmt: skip
        if is_flight_map(self.out):
            order = MapOrder.of(config)
            changes = {
                "file": str(self.target.absolute()), "rate_field": None, "unit": None,
                "layer": None, "sha256": None, "boundary": str(field.boundary_file.absolute()),
            }  # fmt: skip
            order = replace(order, table=order.table.model_copy(update=changes))
            try:
                write_flight_map(self.out, compile_map(order, findings=problems))
            except OSError as error:
                raise not_written(self.out, error) from None
            files = [self.out, *files]
        if self.png is not None:
            from missions.maps.picture import draw  # matplotlib, which not everybody has

            draw(map_file, self.png, title=self.out.name, names=names)
        return files

    def answer(self, result: dict[str, Any], lines: Iterable[str]) -> NoReturn:
        """Print what was made, and end."""
        note_problems(result)
        answer(result, lines, as_json=self.as_json)
        raise typer.Exit(0 if result["ok"] else 1)


making = with_options(
    "making",
    {
        "out": Option(
            Annotated[
                Path,
                typer.Option("--out", metavar="FILE", help="The map; its suffix says the format."),
            ],
            REQUIRED,
        ),
        "config_file": Option(
            Annotated[
                Path, typer.Option("--config", metavar="FILE", help="Configuration of the flight.")
            ],
            REQUIRED,
        ),
        "boundary": Option(
            Annotated[
                Path | None,
                typer.Option(metavar="FILE", help="Field outline; default: prescription.boundary."),
            ]
        ),
        "no_spray": Option(
            Annotated[
                list[Path] | None,
                typer.Option(metavar="FILE", help="Ground not to spray; repeatable."),
            ]
        ),
        "angle_deg": Option(
            Annotated[
                float | None,
                typer.Option(metavar="DEG", help="Course of the passes; default: as vrspray plan."),
            ]
        ),
        "png": Option(
            Annotated[
                Path | None,
                typer.Option("--png", metavar="FILE", help="Picture: .png, .svg or .pdf."),
            ]
        ),
        "format_name": Option(
            Annotated[
                str | None,
                typer.Option(
                    "--format", metavar="F", help="Format, where the suffix allows several."
                ),
            ]
        ),
        "force": Option(
            Annotated[bool, typer.Option("--force", help="Replace existing files.")], False
        ),
        "overrides": Option(Overrides),
        "as_json": Option(AsJson, False),
    },
    Making,
)

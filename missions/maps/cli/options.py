"""What every command on a map asks: the file, what it leaves open, and what the flight adds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from shapely import MultiPolygon

from companion.assembly import above_label, beyond_label, flow_range, undelivered
from companion.cli.answer import Option, Overrides, note, with_options
from companion.config import Config, load
from companion.config.tables import PrescriptionTable
from companion.core.nozzle import rate_for_flow
from companion.core.prescription import Overlap
from companion.errors import MapError
from missions.maps.cli.new import parse_place
from missions.maps.lint import Plan, Sprayer
from missions.maps.lint.survey import Survey
from missions.maps.local import frame_around, grown
from missions.maps.model import MapFile, Problem, map_error
from missions.maps.registry import read_area, read_map, read_records

File = Annotated[Path, typer.Argument(metavar="FILE", help="Prescription map.")]
_RateField = Annotated[
    str | None,
    typer.Option(metavar="F", help="Column, band or product, where there are several."),
]
_Unit = Annotated[
    str | None, typer.Option(metavar="U", help="Unit of the rate, where the file does not say.")
]
_Crs = Annotated[
    str | None, typer.Option(metavar="C", help="Such as EPSG:4326, where the file does not say.")
]
_Layer = Annotated[
    str | None, typer.Option(metavar="L", help="Layer or task, where there are several.")
]
_Density = Annotated[
    float | None,
    typer.Option(metavar="KG_PER_L", help="Density of the product, for rates by weight."),
]
_FlowWidth = Annotated[
    float | None, typer.Option(metavar="M", help="Width for which a map in L/min was made.")
]
_FlowSpeed = Annotated[
    float | None, typer.Option(metavar="M_S", help="Speed for which a map in L/min was made.")
]
_MixRate = Annotated[
    float | None,
    typer.Option(
        metavar="L", help="Litres of mix with one litre of product, for a map of product."
    ),
]
_Scale = Annotated[
    float | None,
    typer.Option(metavar="FACTOR", help="Takes all rates so many times: 0.1 flies 150 L/ha at 15."),
]
_Merge = Annotated[
    str | None,
    typer.Option(metavar="HOW", help="Text map: max, average or mean of points in a cell."),
]
_Origin = Annotated[
    str | None,
    typer.Option(metavar="LAT,LON,ALT", help="Text map: origin of its plane; else point 1."),
]
OverlapPolicy = Annotated[
    str | None,
    typer.Option(
        "--overlap",
        metavar="P",
        help="Rate where zones overlap: max, min, mean or last; error refuses the map.",
    ),
]


def check_overlap(policy: str) -> None:
    """Refuse what is no rule for places where zones overlap."""
    if policy not in get_args(Overlap):
        raise typer.BadParameter(
            f"--overlap is one of {', '.join(get_args(Overlap))}, not {policy!r}"
        )


_ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Configuration of the flight; supplies what is not given here.",
    ),
]


# What a configuration says of the map that it names, and of no other.
_OF_ONE_FILE = frozenset({"rate_field", "layer", "merge", "origin", "mix_rate", "scale"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """The answers to what a map file leaves open, and the configuration they may come from."""

    rate_field: str | None = None
    unit: str | None = None
    crs: str | None = None
    layer: str | None = None
    density_kg_l: float | None = None
    flow_width_m: float | None = None
    flow_speed_m_s: float | None = None
    mix_rate: float | None = None
    scale: float | None = None
    merge: str | None = None
    origin: tuple[float, float, float] | None = None
    config: Config | None = None
    policy: str | None = None

    @property
    def overlap(self) -> str:
        """Return the policy where zones overlap."""
        table = None if self.config is None else self.config.prescription
        return (self.policy or "error") if table is None else table.overlap

    def with_overlap(self, policy: str | None) -> Reading:
        """Return the same with another policy where zones overlap, if one is given."""
        if policy is None:
            return self
        check_overlap(policy)
        table = None if self.config is None else self.config.prescription
        if self.config is None or table is None:
            return replace(self, policy=policy)
        changed = table.model_copy(update={"overlap": policy})
        config = self.config.model_copy(update={"prescription": changed})
        return replace(self, config=config, policy=policy)

    @property
    def answers(self) -> dict[str, Any]:
        """Return what is given for the map itself, its CRS apart."""
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        for name in ("crs", "config", "policy"):
            del given[name]
        return {name: answer for name, answer in given.items() if answer is not None}

    def read(self, file: Path) -> MapFile:
        """Return the map, read as the options say and otherwise as the configuration does.

        Which column and which layer the configuration names, it says of its own map alone.
        """
        table = None if self.config is None else self.config.prescription
        own = table is not None and self._is_own(file, table)
        answers = {}
        for name in (
            field.name for field in fields(self) if field.name not in ("config", "policy")
        ):
            given = getattr(self, name)
            if given is None and table is not None and (own or name not in _OF_ONE_FILE):
                given = getattr(table, name)
            answers[name] = given
        found = read_map(file, **answers)
        if self.policy is not None and found.rule(self.policy) != self.policy:
            raise map_error(
                file,
                f"it was compiled with the rule {found.overlap} where zones overlap",
                fix="leave out --overlap, or compile its source again",
                code="frozen-overlap",
            )
        return found

    def _is_own(self, file: Path, table: PrescriptionTable) -> bool:
        if self.config is None:
            return False
        return file.resolve() == self.config.resolve(table.file).resolve()


_OPTIONS = {
    "rate_field": Option(_RateField),
    "unit": Option(_Unit),
    "crs": Option(_Crs),
    "layer": Option(_Layer),
    "density_kg_l": Option(_Density),
    "flow_width_m": Option(_FlowWidth),
    "flow_speed_m_s": Option(_FlowSpeed),
    "mix_rate": Option(_MixRate),
    "scale": Option(_Scale),
    "merge": Option(_Merge),
    "origin": Option(_Origin),
    "config_file": Option(_ConfigFile),
    "overrides": Option(Overrides),
}


def _reading(
    *,
    config_file: Path | None,
    origin: str | None,
    overrides: Sequence[str] | None,
    **answers: Any,
) -> Reading:
    if overrides and config_file is None:
        raise typer.BadParameter("--set changes a configuration: name one by --config")
    config = None if config_file is None else load(config_file, overrides=overrides or ())
    place = None if origin is None else parse_place(origin, "--origin")
    return Reading(config=config, origin=place, **answers)


# Gives a command that takes `reading: Reading` one option for each answer instead.
reading_options = with_options("reading", _OPTIONS, _reading)


# ----------------------------------------------------------------------------- what the flight adds

# The rates between the least and the largest say nothing more of a sprayer's range.
RATES_MAX = 1_000
# Less than this is what rounding moves.
KEPT_MIN_M2 = 0.01
# Rates so many times beyond what the sprayer applies are of another sprayer, or of product.
FAR = 2.0


def plan_of(config: Config | None, home: tuple[float, float] | None) -> tuple[Plan, list[Problem]]:
    """Return the flight that the configuration describes, and what is wrong with its boundary."""
    homes: tuple[tuple[float, float], ...] = () if home is None else (home,)
    if config is None:
        return Plan(homes=homes), []
    table, mission = config.prescription, config.mission
    if home is None and mission is not None:
        homes = mission.depots
    problems: list[Problem] = []
    boundary, exclusions = None, []
    buffers = list(_buffers(config, problems))
    if table is not None:
        if table.boundary is not None:
            boundary = _area(config, table.boundary, "prescription.boundary", problems)
        for number, name in enumerate(table.exclusions):
            area = _area(config, name, f"prescription.exclusions[{number}]", problems)
            exclusions += [] if area is None else [area]
    plan = Plan(
        boundary=boundary,
        exclusions=(*exclusions, *buffers),
        buffers=tuple(buffers),
        default_rate_l_ha=None if table is None else table.default_rate_l_ha,
        homes=homes,
        sprayer=_sprayer(config),
    )
    return plan, problems


def _area(config: Config, name: str, key: str, problems: list[Problem]) -> MultiPolygon | None:
    """Return a boundary or an exclusion, or None with what is wrong with it."""
    path = config.resolve(name)
    try:
        return read_area(path, nested=key != "prescription.boundary")
    except MapError as error:
        if error.code == "no-file":
            note(f"{key}: {path} is not there; the map is checked without it")
        else:
            problems.append(_refused_area(error, key))
    return None


def _buffers(config: Config, problems: list[Problem]) -> Iterator[MultiPolygon]:
    """Yield the ground that the label keeps free; what cannot be read is an error."""
    for number, each in enumerate(config.buffers):
        for name in each.files:
            try:
                kept = [record.geometry for record in read_records(config.resolve(name))]
            except MapError as error:
                problems.append(_refused_area(error, f"limits.buffer[{number}].files"))
            else:
                yield grown(kept, each.distance_m, frame_around(kept))


def _refused_area(error: MapError, key: str) -> Problem:
    what = {"prescription.boundary": "the boundary"}.get(key, "an exclusion")
    what = "a buffer's file" if key.startswith("limits.") else what
    return Problem(
        severity="error",
        code=error.code,
        text=f"{what} cannot be used: {str(error).removesuffix('; ' + error.fix)}",
        where=key,
        fix=error.fix,
    )


def _sprayer(config: Config) -> Sprayer | None:
    mission, table, lag = config.mission, config.prescription, config.lag
    if mission is None:
        return None
    return Sprayer(
        speed_m_s=mission.speed_m_s,
        lag_s=max(lag.on_s, lag.off_s, lag.up_s, lag.down_s) + lag.output_s,
        period_s=config.pwm_limits().period_s,
        strip_m=min(valve.width_m for valve in config.boom().valves),
        across="centre" if table is None else table.across,
        angle_deg=None if mission.angle_deg == "auto" else mission.angle_deg,
        speed_min_m_s=config.safety.speed_min_m_s,
    )


def sprayer_problems(config: Config | None, map_file: MapFile, plan: Plan) -> list[Problem]:
    """Return what this sprayer and this product have against the rates of the map."""
    rates = rates_in_force(map_file, plan)
    if config is None or not rates:
        return []
    of_label = [
        *beyond_label(config),
        *_kept_free(config, map_file, plan),
        *_other_litres(config, map_file.path, [rate for rate in rates if rate > 0.0]),
    ]
    label = above_label(
        config,
        map_file.path,
        rates_l_ha=map_file.rates_l_ha,
        default_rate_l_ha=_default(config, map_file),
    )
    found = [] if label is None else [label]
    if config.mission is not None:
        found += undelivered(
            _fewer(rates),
            sets=config.nozzle_sets(),
            pwm=config.pwm_limits(),
            width_m=config.boom_table.width_m,
            speed_m_s=config.mission.speed_m_s,
            speeds_m_s=(config.safety.speed_min_m_s, config.safety.speed_max_m_s),
        )
    if not found:
        return of_label
    survey = Survey(map_file)
    positive = [rate for rate in rates if rate > 0.0]
    where = {
        "above-label": max(positive, default=0.0),
        "below-label": min(positive, default=0.0),
        "rate-too-high": max(positive, default=0.0),
        "rate-too-low": min(positive, default=0.0),
    }
    return of_label + [
        replace(problem, where=problem.where or _where(survey, where[problem.code], plan))
        for problem in found
    ]


def _other_litres(config: Config, path: Path, rates_l_ha: Sequence[float]) -> Iterator[Problem]:
    """Ask whether rates far from all that this sprayer applies are litres of something else."""
    if config.mission is None or not rates_l_ha:
        return
    low, high = (
        rate_for_flow(flow, config.mission.speed_m_s, config.boom_table.width_m)
        for flow in flow_range(config.nozzle_sets(), config.pwm_limits())
    )
    said = f"{min(rates_l_ha):g} to {max(rates_l_ha):g} L/ha, where this sprayer applies {low:.3g}"
    said += f" to {high:.3g} L/ha at {config.mission.speed_m_s:g} m/s"
    asked, fix = "", ""
    if max(rates_l_ha) < low / FAR:
        asked = "litres of product"
        fix = "say how many litres of spray mix hold one of product with --mix-rate"
    elif min(rates_l_ha) > high * FAR:
        asked = "for a ground sprayer"
        fix = "take a part of them with --scale, such as --scale 0.1"
    if asked:
        yield Problem(
            severity="warning",
            code="other-litres",
            text=f"are these rates {asked}? They are {said}",
            where=str(path),
            fix=f"if so, {fix} (prescription.mix_rate, scale)",
        )


def _kept_free(config: Config, map_file: MapFile, plan: Plan) -> list[Problem]:
    """Return how much that has a rate is not sprayed for the label's buffers."""
    if not plan.buffers:
        return []
    others = plan.exclusions[: -len(plan.buffers)]
    areas_m2 = []
    for exclusions in (others, plan.exclusions):
        survey = Survey(map_file, boundary=plan.boundary, exclusions=exclusions)
        areas_m2.append(float(survey.inside_m2[survey.rates > 0.0].sum()))
    kept_m2 = areas_m2[0] - areas_m2[1]
    if not kept_m2 > KEPT_MIN_M2:
        return []
    kinds = ", ".join(f"{each.distance_m:g} m from {each.kind}" for each in config.buffers)
    return [Problem(
        severity="warning",
        code="label-buffer",
        text=f"{kept_m2 / 1e4:.4f} ha with a rate are not sprayed for the buffers of "
        f"{config.limits_table.file}: {kinds}",
        where="limits.buffer",
        fix="set these places to 0 in the map, or count on less spray",
    )]  # fmt: skip


def _default(config: Config, map_file: MapFile) -> float | None:
    table = config.prescription
    if table is not None and table.default_rate_l_ha is not None:
        return table.default_rate_l_ha
    return map_file.default_rate_l_ha


def rates_in_force(map_file: MapFile, plan: Plan) -> list[float]:
    """Return all different rates that would be sprayed, the default among them."""
    default = plan.default_rate_l_ha
    if default is None and map_file.boundary is not None:
        default = map_file.default_rate_l_ha
    return sorted({*map_file.rates_l_ha, *([] if default is None else [default])})


def _fewer(rates: Sequence[float]) -> Sequence[float]:
    """Return a map's rates thinned out, with both ends, where each cell has one of its own."""
    if len(rates) <= RATES_MAX:
        return rates
    step = len(rates) // RATES_MAX + 1
    return [*rates[::step], rates[-1]]


def _where(survey: Survey, rate_l_ha: float, plan: Plan) -> str:
    place = survey.rate_spots(rate_l_ha)
    if not place and rate_l_ha in (plan.default_rate_l_ha, survey.map_file.default_rate_l_ha):
        place = "the default rate"
    return f"{rate_l_ha:g} L/ha: {place}" if place else f"{rate_l_ha:g} L/ha"

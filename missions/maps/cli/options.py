"""What every command on a map asks: the file, and what the file itself may leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from companion.cli.answer import Option, Overrides, with_options
from companion.config import Config, load
from companion.config.tables import PrescriptionTable
from companion.core.prescription import Overlap
from missions.maps.cli.new import parse_place
from missions.maps.model import MapFile
from missions.maps.registry import read_map

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
    float | None, typer.Option(metavar="KG_PER_L", help="Of the product, for rates by weight.")
]
_FlowWidth = Annotated[
    float | None, typer.Option(metavar="M", help="Width for which a map in L/min was made.")
]
_FlowSpeed = Annotated[
    float | None, typer.Option(metavar="M_S", help="Speed for which a map in L/min was made.")
]
_Merge = Annotated[
    str | None,
    typer.Option(metavar="HOW", help="P2's text map: max, average or mean of points in a cell."),
]
_Origin = Annotated[
    str | None,
    typer.Option(metavar="LAT,LON,ALT", help="P2's text map: origin of its plane; else point 1."),
]
OverlapPolicy = Annotated[
    str | None,
    typer.Option(
        "--overlap",
        metavar="P",
        help="Where zones overlap: max, min, mean or last holds; error refuses.",
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
        help="Of the flight; what is not given here comes from it.",
    ),
]


# What a configuration says of the map that it names, and of no other.
_OF_ONE_FILE = frozenset({"rate_field", "layer", "merge", "origin"})


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
        return replace(self, config=self.config.model_copy(update={"prescription": changed}))

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
        return read_map(file, **answers)

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

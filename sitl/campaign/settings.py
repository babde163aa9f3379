"""What may be set in a campaign's flight: names such as `vehicle.gust_m_s`, and their values.

`config.` takes every key of the configuration and `plant.` every number of a sprayer profile; what
the other tables have is listed here.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, get_args

from companion.errors import ConfigError
from sitl.airframes import AIRFRAMES
from sitl.conditions import BORDER, CONDITIONS, INSIDE
from sitl.profile import FlowLaw, Meter, PlantProfile, Pulsing, Pump
from sitl.supply import Supply
from sitl.vehicle import Corners

Value = bool | int | float | str | tuple[Any, ...]
# The settings of one flight, in the order of their names.
Settings = tuple[tuple[str, Value], ...]

P1S_FIELD = "published"
Method = Literal["scheduled", "none", "look-ahead", "look-ahead-stated", "calibrated", "perfect"]


@dataclass(frozen=True, slots=True)
class Kind:
    """What a setting takes: a type, and the words that there are or the least and greatest number.

    `is_file` is one that names a file, relative to the campaign's.
    """

    type: type
    words: tuple[str, ...] = ()
    least: float = -math.inf
    most: float = math.inf
    is_file: bool = False


def _number(least: float = 0.0, most: float = math.inf) -> Kind:
    return Kind(float, least=least, most=most)


KINDS: dict[str, Kind] = {
    "flight.config": Kind(str, is_file=True),
    "flight.mission": Kind(str, is_file=True),
    "flight.scenario": Kind(str, is_file=True),
    "flight.field": Kind(str, (P1S_FIELD, *(each.name for each in CONDITIONS))),
    "flight.fidelity": Kind(str, ("averaged", "pulsed")),
    "flight.output": Kind(str, ("gpio", "servo")),
    "flight.board": Kind(str, ("restarting", "free-running")),
    "flight.meter_rate_hz": _number(0.0, 1000.0),
    "flight.perfect": Kind(bool),
    "flight.cpu_max_s": _number(1.0, 1_000_000.0),
    "vehicle.kind": Kind(str, tuple(AIRFRAMES)),
    "vehicle.speed_m_s": _number(0.5, 30.0),
    "vehicle.acceleration_m_s2": _number(0.1, 20.0),
    "vehicle.gust_m_s": _number(0.0, 20.0),
    "vehicle.gust_time_s": _number(0.01, 100.0),
    "vehicle.corners": Kind(str, get_args(Corners)),
    "vehicle.position_rate_hz": _number(0.1, 1000.0),
    "vehicle.estimator_lag_s": _number(0.0, 5.0),
    "vehicle.noise": Kind(bool),
    "map.rate_factor": _number(0.01, 100.0),
    "map.rates": Kind(str, ("by-speed", "as-published")),
    "method.name": Kind(str, get_args(Method)),
    "method.look_ahead_s": _number(0.0, 10.0),
    "method.dose": Kind(str, ("eq-2", "curve")),
    "method.controller": Kind(str),
    "plant.profile": Kind(str),
    "plant.flow_law": Kind(str, get_args(FlowLaw)),
    "plant.scatter": Kind(bool),
    "plant.known": Kind(bool),
    "error.lag_short_s": _number(-5.0, 5.0),
    "error.lags": Kind(list, (*INSIDE, *BORDER)),
    "error.behind_m": _number(-100.0, 100.0),
    "error.along_m": _number(-100.0, 100.0),
    "error.across_m": _number(-100.0, 100.0),
    "error.drift_along_m": _number(-100.0, 100.0),
    "error.drift_across_m": _number(-100.0, 100.0),
}
TABLES = ("config", "plant", "vehicle", "map", "method", "flight", "error")
# They are told along the passes of P1's field, and its rates are those that P1 published.
ON_P1S_FIELD = (
    "error.along_m", "error.across_m", "error.drift_along_m", "error.drift_across_m", "map.rates",
)  # fmt: skip
# A hard condition has its own rates and its own way of flying; files have their own field.
NOT_IN_CONDITIONS = (
    *ON_P1S_FIELD, "map.rate_factor", "vehicle.kind", "vehicle.speed_m_s",
    "vehicle.acceleration_m_s2", "vehicle.gust_m_s", "vehicle.gust_time_s", "vehicle.corners",
)  # fmt: skip
# What that field's flights take from elsewhere: varying it would show a flat line.
NOT_ON_P1S_FIELD = {
    "config.link.position_rate_hz": "write vehicle.position_rate_hz",
    "config.output.kind": "write flight.output",
    "config.mission.": "write vehicle. settings, or give flight.config and flight.mission",
    "config.safety.speed_min_m_s": "give flight.config and flight.mission",
    "config.safety.speed_max_m_s": "give flight.config and flight.mission",
}
NOT_OF_FILES = (*ON_P1S_FIELD, "flight.field", "plant.known")


def check_name(name: str) -> None:
    """Refuse a setting that there is not; the configuration's own keys are checked by loading it.

    Raises:
        ConfigError: in one line.
    """
    table, dot, rest = name.partition(".")
    if table not in TABLES or not dot or not rest:
        raise ConfigError(
            f"{name}: no such setting; begin with one of "
            + ", ".join(f"{each}." for each in TABLES)
        )
    if table == "config" or name in KINDS:
        return
    known = [each for each in KINDS if each.startswith(f"{table}.")]
    if table == "plant":
        known += plant_names()
        if name in known:
            return
    near = difflib.get_close_matches(name, known, n=1)
    fix = f"did you mean {near[0]}?" if near else f"choose of {', '.join(sorted(known))}"
    raise ConfigError(f"{name}: no such setting; {fix}")


def check_value(name: str, value: object) -> Value:
    """Return a value as its setting takes it; a whole number for a fraction is one.

    Raises:
        ConfigError: in one line.
    """
    kind = KINDS.get(name)
    if kind is None:
        if name.startswith("plant."):
            kind = Kind(float)
        elif isinstance(value, list):
            return _frozen(value)
        elif isinstance(value, bool | int | float | str):
            return value
        else:
            raise ConfigError(f"{name}: {value!r} is not a value; write a number, text or list")
    if kind.type is float:
        return _checked_number(name, value, kind)
    if not isinstance(value, kind.type):
        wanted = {str: "text", bool: "true or false", list: "a list"}[kind.type]
        raise ConfigError(f"{name} = {value!r}: write {wanted}")
    words = value if isinstance(value, list) else [value]
    if kind.words and not set(map(str, words)) <= set(kind.words):
        raise ConfigError(f"{name} = {value!r}: choose of {', '.join(kind.words)}")
    return _frozen(value)


def _frozen(value: Any) -> Value:
    found: Value = tuple(map(_frozen, value)) if isinstance(value, list) else value
    return found


def _checked_number(name: str, value: object, kind: Kind) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{name} = {value!r}: write a number")
    if not (math.isfinite(value) and kind.least <= value <= kind.most):
        least, most = f"{kind.least:g}", f"{kind.most:g}"
        raise ConfigError(
            f"{name} = {value!r}: out of range; write a number from {least} to {most}"
        )
    return float(value)


def overrides_of(settings: Mapping[str, Value]) -> tuple[str, ...]:
    """Return those of the configuration as `--set` takes them."""
    return tuple(
        f"{name.removeprefix('config.')}={_toml(value)}"
        for name, value in settings.items()
        if name.startswith("config.")
    )


def _toml(value: Value) -> str:
    """Return a value as TOML writes it.

    >>> _toml(True), _toml(1e-05), _toml(("AUTO", 2))
    ('true', '1e-05', '["AUTO", 2]')
    """
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return json.dumps(value)


# The sprayer: numbers of its profile, also of its parts, as `plant.pwm.frequency_hz`.

_PARTS: dict[str, Any] = {"pwm": Pulsing, "meter": Meter, "pump": Pump, "supply": Supply}


def plant_names() -> list[str]:
    """Return the numbers of a sprayer that can be set."""
    owners = {"": PlantProfile, **{f"{part}.": kind for part, kind in _PARTS.items()}}
    return [
        f"plant.{start}{each.name}"
        for start, owner in owners.items()
        for each in fields(owner)
        if each.type in ("float", "float | None")
    ]


def with_plant(profile: PlantProfile, settings: Mapping[str, Value]) -> PlantProfile:
    """Return a sprayer with the numbers that are set.

    Raises:
        ConfigError: a number that the sprayer has not, or that it cannot be.
    """
    for name, value in settings.items():
        if not name.startswith("plant.") or name in KINDS:
            continue
        try:
            profile = _with(profile, name.split(".")[1:], value)
        except (ValueError, AttributeError) as error:
            raise ConfigError(f"{name} = {value!r}: {error}") from error
    return profile


def _with(part: Any, path: list[str], value: Value) -> Any:
    first, *rest = path
    if not rest:
        return replace(part, **{first: value})
    inner = getattr(part, first)
    if not is_dataclass(inner):
        raise AttributeError(f"this sprayer has no {first}; choose another profile")
    return replace(part, **{first: _with(inner, rest, value)})

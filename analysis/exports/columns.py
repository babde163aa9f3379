"""The columns of tables: their names, units, and values as numbers or text.

`name` has the unit at its end and is used where names may be long; `short` has at most ten
characters, as a dBASE table has them, and follows the names of John Deere's exports where these
have one. What a program does not know it passes over, so the facts of the flight are columns too.

What every export says of itself: which flight, by whose clock, of what, and whether all of it. A
file travels without the journal it came from. Whoever opens it next year must still see that it was
water, that the clock was nobody's, or that the record was cut.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from analysis.exports.samples import Samples, Swaths
    from analysis.flown.applied_flight import AppliedFlight

UNKNOWN = "unknown"
# Of a journal that is older than the mark; its exports stay as they were but for this.
UNMARKED = "unknown: an old journal"


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The facts of a flight that stand in its exports; `training` is `unknown` if nobody said.

    `simulated` is yes, no, or unknown.
    `operator`, `product` and `field_name` are what was asked for before the flight; None without.
    """

    flight: str
    journal: str
    training: str
    simulated: str
    started_utc: str
    ended_utc: str
    utc_source: str
    map_sha256: str
    calibration_sha256: str | None
    operator: str | None
    product: str | None
    field_name: str | None
    is_closed: bool
    lost_rows: int
    recorded_by: str
    exported_by: str

    @property
    def is_training(self) -> bool:
        """Whether it is known that no product was sprayed."""
        return self.training not in ("no", UNKNOWN)

    @property
    def mark(self) -> str:
        """Return what stands in the column `training`: that a flight was simulated goes first."""
        if self.simulated == "yes":
            return "simulated"
        unsure = ", not known whether simulated" if self.simulated == UNKNOWN else ""
        return f"{self.training}{unsure}"

    @property
    def title(self) -> str:
        """Return the name of the flight, with the marks of a simulation and of a training."""
        mark = f" (training: {self.training})" if self.is_training else ""
        return f"{'SIMULATED ' if self.simulated == 'yes' else ''}{self.flight}{mark}"

    def as_json(self) -> dict[str, object]:
        """Return all facts by their names."""
        return {name: getattr(self, name) for name in self.__slots__}

    def as_text(self) -> dict[str, str]:
        """Return all facts that there are, as text."""
        return {
            name: value if isinstance(value, str) else json.dumps(value)
            for name, value in self.as_json().items()
            if value is not None
        }


def about(flight: AppliedFlight) -> About:
    """Return what there is to say of a flight with at least one sample."""
    meta = flight.meta
    asked = _asked_before(meta)
    return About(
        flight=meta.get("flight_id") or flight.path.stem,
        journal=flight.path.name,
        training=flight.training or UNKNOWN,
        simulated=UNMARKED if flight.simulated.is_unmarked else flight.simulated.word,
        started_utc=utc_text(flight.time_s[:1] + flight.utc_offset_s)[0],
        ended_utc=utc_text(flight.time_s[-1:] + flight.utc_offset_s)[0],
        utc_source=flight.utc_source,
        map_sha256=meta.get("map_sha256") or UNKNOWN,
        calibration_sha256=meta.get("calibration_sha256"),
        operator=_text(asked, "application.operator"),
        product=_text(asked, "product.name"),
        field_name=_text(asked, "application.field_name"),
        is_closed=flight.is_closed,
        lost_rows=flight.lost,
        recorded_by=f"vrspray {meta.get('version_vrspray', UNKNOWN)}",
        exported_by=f"vrspray {version('vrspray')}",
    )


def _asked_before(meta: Mapping[str, str]) -> Mapping[str, object]:
    """Return what was told before the flight, by dotted key; nothing where it cannot be read."""
    try:
        found = json.loads(meta.get("application_json") or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _text(values: Mapping[str, object], key: str) -> str | None:
    """Return a text on one line; None where there is none."""
    found = values.get(key)
    if not isinstance(found, str):
        return None
    # JSON can hold half of a pair of UTF-16, which no file of ours can.
    sound = found.encode("utf-8", errors="replace").decode("utf-8")
    return " ".join(sound.split()) or None


# Times as files write them: UTC, ISO 8601, to the millisecond.

Floats = NDArray[np.float64]


def utc_ms(utc_s: Floats) -> NDArray[np.int64]:
    """Return seconds since 1970 as whole milliseconds, to the nearest."""
    found: NDArray[np.int64] = np.rint(np.asarray(utc_s) * 1000.0).astype(np.int64)
    return found


def utc_text(utc_s: Floats) -> list[str]:
    """Return seconds since 1970 as text.

    >>> utc_text(np.array([0.0005, 1774953296.1234]))
    ['1970-01-01T00:00:00.000Z', '2026-03-31T10:34:56.123Z']
    """
    moments = utc_ms(utc_s).astype("datetime64[ms]")
    return [f"{each}Z" for each in np.datetime_as_string(moments, unit="ms").tolist()]


# Units of the columns: metric as recorded, or those of United States farms.
#
# Each unit has its name as it ends a column's name, its name for people, and its code as John Deere
# and ADAPT write it (`l1ha-1`).

System = Literal["metric", "us"]
SYSTEMS: tuple[System, ...] = get_args(System)

# Exact by definition: the inch of 1959, the gallon of 231 cubic inches, the international acre,
# the avoirdupois pound and standard gravity (NIST Handbook 44, appendix C).
_FT_M = 0.3048
_GAL_L = 3.785411784
_ACRE_HA = 0.40468564224
_PSI_KPA = 6.894757293168361


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """A unit: `factor` times a value in the recorded unit is the value in this one."""

    suffix: str
    label: str
    code: str
    decimals: int
    factor: float = 1.0


METRIC: dict[str, Unit] = {
    "rate": Unit(suffix="l_ha", label="L/ha", code="l1ha-1", decimals=4),
    "flow": Unit(suffix="l_min", label="L/min", code="l1min-1", decimals=5),
    "volume": Unit(suffix="ml", label="mL", code="ml", decimals=4),
    "speed": Unit(suffix="m_s", label="m/s", code="m1sec-1", decimals=3),
    "length": Unit(suffix="m", label="m", code="m", decimals=3),
    "area": Unit(suffix="m2", label="m2", code="m2", decimals=3),
    "pressure": Unit(suffix="kpa", label="kPa", code="kPa", decimals=2),
    "angle": Unit(suffix="deg", label="deg", code="arcdeg", decimals=2),
    "time": Unit(suffix="s", label="s", code="sec", decimals=4),
    "duty": Unit(suffix="", label="fraction", code="ratio", decimals=4),
}
US: dict[str, Unit] = METRIC | {
    "rate": Unit(
        suffix="gal_ac", label="gal/ac", code="gal1ac-1", decimals=6, factor=_ACRE_HA / _GAL_L
    ),
    "flow": Unit(
        suffix="gal_min", label="gal/min", code="gal1min-1", decimals=6, factor=1.0 / _GAL_L
    ),
    "volume": Unit(
        suffix="fl_oz", label="fl oz", code="floz", decimals=5, factor=128.0 / (1000.0 * _GAL_L)
    ),
    "speed": Unit(
        suffix="mph", label="mph", code="mi1hr-1", decimals=3, factor=3600.0 / (5280.0 * _FT_M)
    ),
    "length": Unit(suffix="ft", label="ft", code="ft", decimals=3, factor=1.0 / _FT_M),
    "area": Unit(suffix="ft2", label="ft2", code="ft2", decimals=2, factor=1.0 / _FT_M**2),
    "pressure": Unit(suffix="psi", label="psi", code="psi", decimals=3, factor=1.0 / _PSI_KPA),
}


def units_of(system: System) -> dict[str, Unit]:
    """Return the unit of each quantity.

    >>> round(100.0 * units_of("us")["rate"].factor, 4)
    10.6907
    """
    return METRIC if system == "metric" else US


Value = float | str | None

# As many digits of the map's hash as tell maps apart by eye; the whole one is in the metadata.
_HASH_DIGITS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column; `unit` is None for text, `values` are numbers (NaN: nothing) or text."""

    name: str
    short: str
    description: str
    unit: Unit | None
    values: Floats | Sequence[str]

    def python(self) -> list[Value]:
        """Return the values as numbers rounded to what they mean, or text; None for nothing."""
        if self.unit is None or not isinstance(self.values, np.ndarray):
            return [value or None for value in self.values]
        rounded = np.round(self.values, self.unit.decimals)
        known = np.isfinite(rounded)
        found: list[Value] = rounded.tolist()
        return (
            found
            if known.all()
            else [
                value if there else None for value, there in zip(found, known.tolist(), strict=True)
            ]
        )

    def texts(self) -> list[str]:
        """Return the values as text; "" for nothing."""
        if self.unit is None or not isinstance(self.values, np.ndarray):
            return [str(value) for value in self.values]
        form = f"%.{self.unit.decimals}f"
        return [form % value if value == value else "" for value in self.values.tolist()]


Of = Callable[[str, str, str, str, Floats], Column]


def column_in(units: dict[str, Unit]) -> Of:
    """Return what makes columns: name without unit, short name, quantity, meaning, values."""

    def of(name: str, short: str, quantity: str, description: str, values: Floats) -> Column:
        unit = units[quantity]
        return Column(
            name=f"{name}_{unit.suffix}" if unit.suffix else name,
            short=short,
            description=description,
            unit=unit,
            values=values * unit.factor,
        )

    return of


def text_column(name: str, short: str, description: str, values: Sequence[str]) -> Column:
    """Return a column of text."""
    return Column(name=name, short=short, description=description, unit=None, values=values)


def point_columns(samples: Samples, about: About, units: dict[str, Unit]) -> list[Column]:
    """Return the columns of points, without their place; the facts of the flight come last."""
    of = column_in(units)
    columns = [
        text_column("time_utc", "IsoTime", "UTC, ISO 8601", utc_text(samples.utc_s)),
        of("time", "FlightTime", "time", "monotonic clock of the companion", samples.time_s),
        of("height", "Height", "length", "above the take-off place", samples.height_m),
        of("speed", "VEHICLSPEE", "speed", "over ground", samples.speed_m_s),
        of("course", "Course", "angle", "of motion, from north", samples.course_deg),
        of("heading", "Heading", "angle", "of the nose, from north", samples.heading_deg),
        of("target_rate", "TargetRate", "rate", "prescribed", samples.rate_l_ha),
        of("applied_rate", "AppliedRat", "rate", "over the open valves", samples.applied_l_ha),
        of("target_flow", "TargetFlow", "flow", "asked for", samples.target_flow_l_min),
        of("flow", "Flow", "flow", "of all valves, by the model", samples.flow_l_min),
        of("volume", "Volume", "volume", "in the time of this row", samples.volume_ml),
        of("distance", "DISTANCE", "length", "in the time of this row", samples.distance_m),
        of("width", "SWATHWIDTH", "length", "of the open valves", samples.width_m),
        of("area", "Area", "area", "covered in the time of this row", samples.area_m2),
        of("duty", "Duty", "duty", "mean of the open valves, 0 to 1", samples.duty),
    ]
    if samples.pressure_kpa is not None:
        columns.append(
            of("pressure", "Pressure", "pressure", "of the liquid", samples.pressure_kpa)
        )
    columns.append(text_column("inhibits", "Inhibits", "reasons not to spray", samples.inhibits))
    return columns + _facts(about, len(samples))


def valve_columns(samples: Samples, names: Iterable[str], units: dict[str, Unit]) -> list[Column]:
    """Return what each valve did: what was prescribed under it, its flow and its duty."""
    of = column_in(units)
    columns = []
    for valve, name in enumerate(plain_names(names)):
        columns += [
            of(f"target_rate_{name}", "", "rate", "prescribed", samples.valve_rate_l_ha[:, valve]),
            of(f"flow_{name}", "", "flow", "by the model", samples.valve_flow_l_min[:, valve]),
            of(f"duty_{name}", "", "duty", "ordered, 0 to 1", samples.valve_duty[:, valve]),
        ]
    return columns


def swath_columns(
    swaths: Swaths, about: About, units: dict[str, Unit], names: Sequence[str]
) -> list[Column]:
    """Return the columns of polygons, without their shape; the facts of the flight come last."""
    of = column_in(units)
    start_s, end_s = (each + swaths.utc_offset_s for each in (swaths.start_s, swaths.end_s))
    valves = [names[valve] for valve in swaths.valve.tolist()]
    return [
        text_column("time_utc", "IsoTime", "begin, UTC, ISO 8601", utc_text(start_s)),
        text_column("end_utc", "IsoTimeEnd", "end, UTC, ISO 8601", utc_text(end_s)),
        of("time", "FlightTime", "time", "begin, monotonic clock", swaths.start_s),
        text_column("valve", "SECTIONID", "name of the valve", valves),
        of("height", "Height", "length", "above the take-off place", swaths.height_m),
        of("speed", "VEHICLSPEE", "speed", "over ground, mean", swaths.speed_m_s),
        of("heading", "Heading", "angle", "of the nose, from north", swaths.heading_deg),
        of("target_rate", "TargetRate", "rate", "prescribed", swaths.rate_l_ha),
        of("applied_rate", "AppliedRat", "rate", "mean over the polygon", swaths.applied_l_ha),
        of("volume", "Volume", "volume", "on this polygon", swaths.volume_ml),
        of("area", "Area", "area", "swept", swaths.area_m2),
        of("distance", "DISTANCE", "length", "flown", swaths.distance_m),
        of("width", "SWATHWIDTH", "length", "of the strip", swaths.width_m),
        of("duty", "Duty", "duty", "ordered at the middle, 0 to 1", swaths.duty),
        *_facts(about, len(swaths)),
    ]


def plain_names(names: Iterable[str]) -> list[str]:
    """Return names of valves as they may stand in the name of a column, all different.

    >>> plain_names(["left 1", "left-1", "4"])
    ['left_1', 'left_1_2', 'v4']
    """
    found: list[str] = []
    for number, name in enumerate(names, start=1):
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or f"v{number}"
        plain = f"v{plain}" if plain[0].isdigit() else plain
        found.append(plain if plain not in found else f"{plain}_{number}")
    return found


def _facts(about: About, count: int) -> list[Column]:
    """Return the facts that must not be lost with a file beside."""
    return [
        text_column(name, short, description, [value] * count)
        for name, short, description, value in (
            ("flight", "Flight", "name of the record", about.flight),
            (
                "training",
                "Training",
                "water, dry, simulated, no (a product) or unknown",
                about.mark,
            ),
            ("utc_source", "UtcSource", "whose clock", about.utc_source),
            ("map", "MapHash", "begin of the map's SHA-256", about.map_sha256[:_HASH_DIGITS]),
        )
    ]

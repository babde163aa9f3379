"""What the flight itself tells for a legal record, and the fields that are made of it."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from companion.config.application_table import Profile, is_told
from companion.config.legal_entries import check, is_number, known
from companion.config.limits import declared_over
from companion.config.model import parse_value
from companion.errors import ConfigError
from companion.journal.writer import DECLARED_META
from companion.simulated import Simulated
from companion.wording import read_toml

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from analysis.assess.ground import Treated
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.report.clock import Clock

# What people said for the record: before the flight by the configuration, after it by options.
#
# What is said afterwards is marked so for good: an inspector sees which entries are as old as the
# flight and which are not.

TABLES = ("application", "product")
# Counts only after the flight: in a configuration it would vouch for every simulation too.
REAL_FLIGHT = "application.real_flight"


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """Values by dotted key, such as `application.customer`; `after` names those said afterwards.

    `before` has what the journal said instead, of those that were corrected.
    """

    values: Mapping[str, Any]
    after: frozenset[str]
    before: Mapping[str, Any]
    # From when on which values held: the operator may declare the weather anew between flights.
    periods: tuple[tuple[float, Mapping[str, Any]], ...]


def told_in(meta: Mapping[str, str], *, until_s: float = math.inf) -> dict[str, Any]:
    """Return what the journal itself says, of the weather what was declared last until a time."""
    return _periods_in(meta, until_s)[-1][1]


def _periods_in(meta: Mapping[str, str], until_s: float) -> list[tuple[float, dict[str, Any]]]:
    """Return from when on which values held; the first are those of the start."""
    found = [(-math.inf, _told_at_start(meta))]
    try:
        declared = json.loads(meta.get(DECLARED_META, "[]"))
        pairs = [(float(at_s), json.loads(said)) for at_s, said in declared]
    except (ValueError, TypeError):  # a damaged text: nothing was declared
        return found
    for at_s, said in pairs:
        if at_s <= until_s and isinstance(said, dict):
            sound = {key: value for key, value in said.items() if _is_entry(key, value)}
            found.append((at_s, declared_over(found[0][1], sound)))
    return found


def _told_at_start(meta: Mapping[str, str]) -> dict[str, Any]:
    """Return what was said before the start; of older journals, by their configuration's text."""
    try:
        if "application_json" in meta:
            found = json.loads(meta["application_json"])
        else:
            found = _flat(tomllib.loads(meta.get("config_toml", "")))
    except ValueError:  # a damaged text: nothing was said
        return {}
    if not isinstance(found, dict):
        return {}
    return {
        key: value
        for key, value in found.items()
        if key != REAL_FLIGHT and is_told(value) and _is_entry(key, value)
    }


def _is_entry(key: str, value: Any) -> bool:
    """Return whether this could have been said: what a file was made to say is not believed."""
    if key not in known():
        return False
    try:
        check({key: value})
    except ConfigError:
        return False
    return True


def told_with(
    meta: Mapping[str, str],
    *,
    file: Path | None = None,
    changes: Sequence[str] = (),
    until_s: float = math.inf,
) -> Told:
    """Return what was said in all; ConfigError, in one line, for what cannot be an entry.

    What was declared after `until_s`, the end of the spraying, is of the next flight.
    """
    periods = _periods_in(meta, until_s)
    before = periods[-1][1]
    later = {} if file is None else _read(file)
    later |= dict(_parsed(change) for change in changes)
    values = {**before, **later}
    check(later)
    after = {key for key, value in later.items() if before.get(key) != value}
    return Told(
        values={key: value for key, value in values.items() if is_told(value)},
        after=frozenset(after),
        before={key: before[key] for key in after & before.keys()},
        periods=tuple((at_s, {**told, **later}) for at_s, told in periods),
    )


def _flat(document: Mapping[str, Any]) -> dict[str, Any]:
    return {
        f"{table}.{key}": value
        for table in TABLES
        if isinstance(document.get(table), dict)
        for key, value in document[table].items()
    }


def _read(file: Path) -> dict[str, Any]:
    """Return the entries of a TOML file with the tables [application] and [product]."""
    found = _flat(read_toml(file, what="an application")[1])
    if not found:
        raise ConfigError(f"{file}: has neither [application] nor [product]")
    return found


def _parsed(change: str) -> tuple[str, Any]:
    """Return key and value of KEY=VALUE; what TOML does not know is text.

    >>> _parsed('application.customer="A. Farmer"'), _parsed("application.crop_eppo=TRZAW")
    (('application.customer', 'A. Farmer'), ('application.crop_eppo', 'TRZAW'))
    >>> _parsed("application.growth_stage_bbch=31"), _parsed("application.wind_m_s=2")
    (('application.growth_stage_bbch', '31'), ('application.wind_m_s', 2))
    """
    key, equals, text = change.partition("=")
    key, text = key.strip(), text.strip()
    if not equals or key not in known():
        raise ConfigError(
            f"--set {change}: no entry of the record; write one such as application.customer=NAME "
            "or product.name=NAME"
        )
    value = parse_value(text)
    # A certificate's number and a growth stage are digits, and no numbers.
    return key, value if isinstance(value, str) or is_number(key) else text


# The US liquid gallon, exact by definition (231 cubic inches).
LITRES_PER_GALLON = 3.785411784
ACRES_PER_HA = 2.4710538


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What the journal says, as the records need it; None where it says nothing.

    `time_said` tells whose clock the times are by. `ends_spraying`: the journal ends with valves
    open, so that area and quantity are not all.
    """

    date: str | None
    start_time: str | None
    end_time: str | None
    time_zone: str
    time_said: str
    clock_source: str
    latitude_deg: float | None
    longitude_deg: float | None
    area_ha: float
    volume_l: float
    volume_by: str
    modelled_l: float | None
    mean_rate_l_ha: float | None
    asked_rate_l_ha: float | None
    boom_width_m: float
    height_m: float | None
    speed_m_s: float | None
    wind_m_s: float | None
    wind_note: str
    training: str | None
    simulated: Simulated
    is_closed: bool
    lost_rows: int
    ends_spraying: bool
    map_sha256: str
    treated_area: dict[str, Any]

    @property
    def has_area(self) -> bool:
        """Return whether anything was sprayed."""
        return self.area_ha > 0.0


def _no_unit(_: Told) -> str:
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """A field that is computed; `value` gives None where it cannot be, which some may be."""

    name: str
    label: str
    value: Callable[[Facts, Told], Any]
    unit: Callable[[Told], str] = _no_unit
    is_time: bool = False
    is_optional: bool = False


def _in(unit: str) -> Callable[[Told], str]:
    return lambda _: unit


def _product_unit(told: Told) -> str:
    return str(told.values.get("application.product_unit") or "")


def _product(facts: Facts, told: Told) -> float | None:
    """Return the product in what was sprayed, in its own unit."""
    per_l = told.values.get("application.product_per_l")
    if not is_told(per_l) or not _product_unit(told) or not facts.has_area:
        return None
    return round(facts.volume_l * float(per_l), 4)  # type: ignore[arg-type] # checked when told


def _dose(facts: Facts, told: Told) -> float | None:
    product = _product(facts, told)
    return None if product is None else round(product / facts.area_ha, 3)


def _place(facts: Facts, _: Told) -> str | None:
    if facts.latitude_deg is None or facts.longitude_deg is None:
        return None
    return f"{facts.latitude_deg:.6f}, {facts.longitude_deg:.6f}"


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _measured(
    name: str, label: str, unit: str, digits: int, value: Callable[[Facts], float | None]
) -> Field:
    return Field(
        name=name, label=label, unit=_in(unit), value=lambda f, _: _rounded(value(f), digits)
    )


def _volume(facts: Facts, _: Told) -> float | None:
    return round(facts.volume_l, 3) if facts.has_area else None


def _area(facts: Facts, _: Told) -> float | None:
    return round(facts.area_ha, 4) if facts.has_area else None


DATE = Field(name="date", label="Date", value=lambda f, _: f.date, is_time=True)
START = Field(
    name="start_time", label="Start of spraying", value=lambda f, _: f.start_time, is_time=True
)
END = Field(name="end_time", label="End of spraying", value=lambda f, _: f.end_time, is_time=True)
PLACE = Field(name="location", label="Place (latitude, longitude, WGS84)", value=_place)
AREA = Field(name="treated_area_ha", label="Treated area", value=_area, unit=_in("ha"))
VOLUME = Field(name="volume_l", label="Spray mixture applied", value=_volume, unit=_in("L"))
PRODUCT = Field(
    name="product_quantity",
    label="Product in it",
    value=_product,
    unit=_product_unit,
    is_optional=True,
)
RATE = Field(
    name="mean_rate_l_ha",
    label="Mixture applied, mean",
    value=lambda f, _: _rounded(f.mean_rate_l_ha, 2),
    unit=_in("L/ha"),
)

DOSE = Field(
    name="dose",
    label="Dose of the product, mean",
    value=_dose,
    unit=lambda told: f"{_product_unit(told)}/ha" if _product_unit(told) else "",
)
GEODATA = Field(
    name="geodata",
    label="Treated area as geodata",
    value=lambda f, _: "treated_area in the JSON, WGS84" if f.has_area else None,
)
HOW = (
    _measured("boom_width_m", "Effective width of the boom", "m", 2, lambda f: f.boom_width_m),
    _measured("height_m", "Height while spraying, mean", "m", 1, lambda f: f.height_m),
    _measured("speed_m_s", "Speed while spraying, mean", "m/s", 1, lambda f: f.speed_m_s),
)

FIELDS: dict[Profile, tuple[Field, ...]] = {
    "eu": (
        Field(
            name="type_of_use",
            label="Type of use",
            value=lambda f, _: "treatment of a surface area, outdoors" if f.has_area else None,
        ),
        DATE,
        START,
        END,
        DOSE,
        AREA,
        PLACE,
        GEODATA,
        PRODUCT,
        VOLUME,
        RATE,
    ),
    "us": (
        DATE,
        START,
        END,
        Field(
            name="quantity_gal",
            label="Quantity of material dispensed, as sprayed",
            value=lambda f, _: round(f.volume_l / LITRES_PER_GALLON, 3) if f.has_area else None,
            unit=_in("US gal"),
        ),
        VOLUME,
        PRODUCT,
        Field(
            name="treated_area_ac",
            label="Treated area",
            value=lambda f, _: round(f.area_ha * ACRES_PER_HA, 3) if f.has_area else None,
            unit=_in("acre"),
        ),
        PLACE,
    ),
    "australia": (
        DATE,
        START,
        END,
        PLACE,
        AREA,
        GEODATA,
        RATE,
        VOLUME,
        replace(PRODUCT, is_optional=False),
        DOSE,
        *HOW,
    ),
    "generic": (
        DATE,
        START,
        END,
        PLACE,
        AREA,
        VOLUME,
        PRODUCT,
        RATE,
        _measured(
            "asked_rate_l_ha", "Mixture prescribed, mean", "L/ha", 2, lambda f: f.asked_rate_l_ha
        ),
        *HOW,
        Field(
            name="map_sha256",
            label="Prescription map, SHA-256",
            value=lambda f, _: f.map_sha256 or None,
            is_optional=True,
        ),
    ),
}

LABELS: dict[str, tuple[str, str]] = {
    "application.operator": ("Applied by (professional user)", ""),
    "application.licence": ("Licence of the operator", ""),
    "application.customer": ("Customer", ""),
    "application.customer_address": ("Address of the customer", ""),
    "application.customer_contact": ("Contact of the customer", ""),
    "application.pilot": ("Pilot", ""),
    "application.pilot_address": ("Address of the pilot", ""),
    "application.pilot_certificate": ("Certificate of the pilot", ""),
    "application.pilot_skills_date": ("Knowledge and skill met, 137.19(e)", ""),
    "application.field_name": ("Field", ""),
    "application.land_address": ("Address of the land", ""),
    "application.parcel": ("Parcel", ""),
    "application.purpose": ("Purpose", ""),
    "application.crop": ("Crop", ""),
    "application.crop_eppo": ("Crop, EPPO code", ""),
    "application.growth_stage_bbch": ("Growth stage, BBCH", ""),
    "application.product_per_l": ("Product in one litre of mixture", ""),
    "application.product_unit": ("Unit of the product", ""),
    "application.diluent": ("Water and additives", ""),
    "application.aircraft": ("Aircraft", ""),
    "application.nozzles": ("Nozzles", ""),
    "application.wind_m_s": ("Wind speed", "m/s"),
    "application.wind_from_deg": ("Wind from", "deg"),
    "application.temperature_c": ("Temperature", "deg C"),
    "application.humidity_percent": ("Relative humidity", "%"),
    "application.observed_at": ("Weather observed at", ""),
    "application.inversion": ("Temperature inversion", ""),
    "product.name": ("Product", ""),
    "product.registration": ("Authorisation or registration number", ""),
    "product.active_constituents": ("Active constituents", ""),
    "product.droplet_class": ("Droplet class", ""),
    "application.real_flight": ("A real flight, as the operator says", ""),
}


def label_of(key: str) -> tuple[str, str]:
    """Return label and unit of what an operator says."""
    return LABELS[key]


# Valves that were open this shortly before the journal ends were open when it was cut.
CUT_WITHIN_S = 1.5


def facts_of(
    flight: AppliedFlight,
    treated: Treated,
    clock: Clock,
    *,
    volume_l: float,
    volume_by: str,
    prescribed_l: float | None,
    modelled_l: float | None = None,
    unread: int = 0,
) -> Facts:
    """Return the facts; `volume_by` says in words what measured `volume_l`.

    `unread` is how many parts of the journal could not be read; they count as lost rows.
    """
    first = clock.at(treated.first_s)
    spraying = while_spraying(flight)
    latitude_deg, longitude_deg = _place_of(flight, treated)
    area_ha = treated.area_ha
    return Facts(
        date=None if first is None else first.date().isoformat(),
        start_time=clock.text(treated.first_s),
        end_time=clock.text(treated.last_s),
        time_zone=clock.zone_name,
        time_said=clock.source_text,
        clock_source=clock.source,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        area_ha=area_ha,
        volume_l=volume_l,
        volume_by=volume_by,
        modelled_l=modelled_l,
        mean_rate_l_ha=volume_l / area_ha if area_ha > 0.0 else None,
        asked_rate_l_ha=None
        if prescribed_l is None or not area_ha > 0.0
        else prescribed_l / area_ha,
        boom_width_m=flight.setup.boom.width_m,
        height_m=_mean(flight.height_m[spraying]),
        speed_m_s=_mean(flight.speed_m_s[spraying]),
        wind_m_s=_wind(flight, treated),
        wind_note=wind_note(flight),
        training=flight.training,
        simulated=flight.simulated,
        is_closed=flight.is_closed,
        lost_rows=flight.lost + unread,
        ends_spraying=ends_spraying(flight, treated),
        map_sha256=flight.setup.prescription.sha256,
        treated_area=treated.as_geojson(flight.setup.frame),
    )


def while_spraying(flight: AppliedFlight) -> np.ndarray:
    """Return which samples lie in spraying, by the flow that is ordered."""
    return np.asarray(flight.flow_l_min > 0.0)


def ends_spraying(flight: AppliedFlight, treated: Treated) -> bool:
    """Return whether the journal was cut while valves were open."""
    if flight.is_closed or treated.last_s is None or not len(flight.time_s):
        return False
    return bool(flight.time_s[-1] - treated.last_s <= CUT_WITHIN_S)


def _place_of(flight: AppliedFlight, treated: Treated) -> tuple[float | None, float | None]:
    """Return a place on the treated ground."""
    if treated.area.is_empty:
        return None, None
    point = treated.area.representative_point()
    return flight.setup.frame.to_geographic(float(point.x), float(point.y))


def _wind(flight: AppliedFlight, treated: Treated) -> float | None:
    series = flight.wind_m_s
    if series is None or treated.first_s is None or treated.last_s is None:
        return None
    inside = (series.time_s >= treated.first_s) & (series.time_s <= treated.last_s)
    return _mean(series.value[inside & is_estimate(series.value)])


def is_estimate(wind_m_s: Floats) -> NDArray[np.bool_]:
    """Return which winds are estimates: not exactly 0, and not the same as the one before.

    The companion says so itself now; journals of before hold what the autopilot told.
    """
    moves = np.concatenate(([False], wind_m_s[1:] != wind_m_s[:-1]))
    return np.asarray(np.isfinite(wind_m_s) & (wind_m_s != 0.0) & moves)


def wind_note(flight: AppliedFlight) -> str:
    """Return that the autopilot told winds and knew none; empty where it told none, or knew it."""
    series = flight.wind_m_s
    if series is None or is_estimate(series.value).any():
        return ""
    return "the wind in flight is not known: the autopilot told exactly 0, or always the same"


def _mean(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None

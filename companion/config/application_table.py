"""The table of the legal record: who, for whom, what, on which crop, in which weather.

Nothing of it moves a valve. It is asked for before the flight, because afterwards nobody remembers;
the journal keeps it, and the report makes the record of it (docs/howto/legal-record.md).
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import date, datetime
from typing import Annotated, Any, Literal, get_args
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

from pydantic import AfterValidator, Field, FiniteFloat
from pydantic_core import PydanticCustomError

from companion.config.tables import ProductTable, Table, Text

Profile = Literal["eu", "us", "australia", "generic"]
PROFILES: tuple[Profile, ...] = get_args(Profile)

# Figures are those of ASCII: in a pattern \d is a figure of any script.
_DAY = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$"
# Whole minutes or seconds, and always with an offset from UTC: a time without one is two times.
_MOMENT = (
    _DAY[:-1] + r"T([01][0-9]|2[0-3]):[0-5][0-9](:[0-5][0-9])?(Z|[+-](0[0-9]|1[0-4]):[0-5][0-9])$"
)


def _is_some(parse: Callable[[str], object], wrong: str) -> AfterValidator:
    """Return the check that there is what a text names: a pattern takes the 31st of February."""

    def checked(value: str) -> str:
        try:
            parse(value)
        except ValueError as error:
            raise PydanticCustomError("is_none", wrong) from error
        return value

    return AfterValidator(checked)


def _a_stage(value: str) -> str:
    """Return a stage, or a range of stages that does not go backwards."""
    first, _, last = value.partition("-")
    if first.isdigit() and last and not first < last:
        raise PydanticCustomError("no_range", "the later stage stands first")
    return value


def zone_named(name: str) -> ZoneInfo | None:
    """Return a time zone; None where this computer knows none of that name."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return None


def _a_zone(value: str) -> str:
    """Return a time zone that is known; any where this computer knows none at all."""
    if zone_named(value) is None and available_timezones():
        raise PydanticCustomError("no_zone", "no such time zone")
    return value


class ApplicationTable(Table):
    """What the law wants to know of an application and no sensor can tell."""

    profile: Profile | None = Field(
        default=None,
        description="whose record: eu (2023/564), us (14 CFR 137.71), australia, generic; "
        "absent: none",
    )
    time_zone: Annotated[Text, AfterValidator(_a_zone)] | None = Field(
        default=None, description="of the times in record and report, such as Europe/Madrid"
    )
    operator: Text | None = Field(
        default=None, description="who applies it: the professional user, by name"
    )
    licence: Text | None = Field(default=None, description="of the operator, number")
    customer: Text | None = Field(default=None, description="for whom it is applied, by name")
    customer_address: Text | None = Field(default=None, description="of the customer")
    customer_contact: Text | None = Field(
        default=None, description="of the customer: telephone or e-mail"
    )
    pilot: Text | None = Field(default=None, description="in command, by name")
    pilot_address: Text | None = Field(default=None, description="of the pilot")
    pilot_certificate: Text | None = Field(default=None, description="of the pilot, number")
    pilot_skills_date: Annotated[str, _is_some(date.fromisoformat, "no such day")] | None = Field(
        default=None,
        pattern=_DAY,
        description="day on which the pilot met the requirements of 137.19(e), YYYY-MM-DD",
    )
    field_name: Text | None = Field(default=None, description="what the farm calls the field")
    land_address: Text | None = Field(default=None, description="of the treated land")
    parcel: Text | None = Field(
        default=None, description="the parcel's number in the register of the aid application"
    )
    purpose: Text | None = Field(default=None, description="against what, or what for")
    crop: Text | None = Field(default=None, description="by its name, or what else is treated")
    crop_eppo: str | None = Field(
        default=None, pattern=r"^[A-Z0-9]{5,6}$", description="its EPPO code, such as TRZAW"
    )
    growth_stage_bbch: Annotated[str, AfterValidator(_a_stage)] | None = Field(
        default=None,
        pattern=r"^([0-9]{2}(-[0-9]{2})?|not-required)$",
        description="BBCH stage: 31, or 31-33; not-required where the label sets no stage",
    )
    product_per_l: float | None = Field(
        default=None, gt=0, le=10, description="product in one litre of what is sprayed"
    )
    product_unit: Literal["L", "kg"] | None = Field(
        default=None, description="unit of product_per_l, and of the dose for each hectare"
    )
    diluent: Text | None = Field(
        default=None, description="water and additives of the mixture, with their amounts"
    )
    aircraft: Text | None = Field(
        default=None, description="make, and registration or serial number"
    )
    nozzles: Text | None = Field(default=None, description="make and size")
    wind_m_s: Annotated[FiniteFloat, Field(ge=0, le=60)] | None = Field(
        default=None, description="measured on the ground before the flight"
    )
    wind_from_deg: Annotated[FiniteFloat, Field(ge=0, le=360)] | None = Field(
        default=None, description="where it comes from, clockwise from north"
    )
    temperature_c: Annotated[FiniteFloat, Field(ge=-40, le=60)] | None = Field(
        default=None, description="of the air"
    )
    humidity_percent: Annotated[FiniteFloat, Field(ge=0, le=100)] | None = Field(
        default=None, description="of the air, relative"
    )
    inversion: Literal["no", "yes"] | None = Field(
        default=None, description="whether the air lies in a temperature inversion, as seen"
    )
    observed_at: Annotated[str, _is_some(datetime.fromisoformat, "no such time")] | None = Field(
        default=None,
        pattern=_MOMENT,
        description="when this weather was observed, such as 2026-05-01T06:30:00+02:00",
    )
    start_time: Annotated[str, _is_some(datetime.fromisoformat, "no such time")] | None = Field(
        default=None,
        pattern=_MOMENT,
        description="only where no clock was right: start of spraying, 2026-05-01T06:30:00+02:00",
    )
    real_flight: Literal["yes"] | None = Field(
        default=None,
        description="only after the flight, where nothing told whether it was simulated: yes",
    )
    remarks: Text | None = Field(default=None, description="for the record")


def told(application: ApplicationTable, product: ProductTable) -> dict[str, Any]:
    """Return what the configuration says for the record, by dotted key; what it does not, not."""
    tables: dict[str, Table] = {"application": application, "product": product}
    return {
        f"{name}.{key}": value
        for name, table in tables.items()
        for key, value in table.model_dump(mode="json").items()
        if is_told(value)
    }


def is_told(value: object) -> bool:
    """Return whether a value says anything.

    >>> is_told(0.0), is_told("  "), is_told(None)
    (True, False, False)
    """
    return value is not None and str(value).strip() != ""

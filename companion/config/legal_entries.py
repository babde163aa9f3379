"""Which law asks for what in the record of an application, and whether an entry can be one.

Here, so that `run` and `doctor` can name what is missing before a flight; loaded where a profile is
asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from companion.config.application_table import ApplicationTable, Profile, is_told
from companion.config.tables import ProductTable, Table
from companion.config.wording import say
from companion.errors import ConfigError

# What each law wants from the operator, as keys of the configuration; what the flight itself tells
# (area, place, times, quantity) is added by the report. Sources: docs/howto/legal-record.md.
ASKED: dict[Profile, tuple[str, ...]] = {
    "eu": (
        "application.operator",
        "application.parcel",
        "application.crop_eppo",
        "application.growth_stage_bbch",
        "product.name",
        "product.registration",
        "application.product_per_l",
        "application.product_unit",
    ),
    "us": (
        "application.customer",
        "application.customer_address",
        "product.name",
        "application.pilot",
        "application.pilot_address",
        "application.pilot_certificate",
        "application.pilot_skills_date",
    ),
    # Pesticides Regulation 2017 (NSW), clause 26(4), for those with an aerial or RPA applicator
    # business licence; and what Queensland asks of an aerial distribution contractor besides.
    "australia": (
        "application.operator",
        "application.pilot",
        "application.pilot_address",
        "application.customer",
        "application.customer_address",
        "application.customer_contact",
        "application.land_address",
        "application.field_name",
        "application.crop",
        "application.purpose",
        "product.name",
        "product.active_constituents",
        "product.registration",
        "application.product_per_l",
        "application.product_unit",
        "application.diluent",
        "application.aircraft",
        "application.nozzles",
        "application.wind_m_s",
        "application.wind_from_deg",
        "application.temperature_c",
        "application.humidity_percent",
        "application.inversion",
    ),
    "generic": (
        "application.operator",
        "application.licence",
        "application.customer",
        "application.field_name",
        "application.crop",
        "product.name",
        "product.registration",
        "product.droplet_class",
        "application.nozzles",
        "application.aircraft",
        "application.wind_m_s",
        "application.wind_from_deg",
        "application.temperature_c",
        "application.humidity_percent",
    ),
}


class _Tables(Table):
    """The two tables of the configuration that a record is made of."""

    application: ApplicationTable = ApplicationTable()
    product: ProductTable = ProductTable()


def known() -> set[str]:
    """Return the dotted keys of all that can be said for the record."""
    fields = {"application": ApplicationTable.model_fields, "product": ProductTable.model_fields}
    return {f"{table}.{key}" for table, keys in fields.items() for key in keys}


def is_number(key: str) -> bool:
    """Return whether the entry of a known dotted key is a number."""
    table, _, name = key.partition(".")
    fields = ApplicationTable.model_fields if table == "application" else ProductTable.model_fields
    return "float" in str(fields[name].annotation)


def check(values: Mapping[str, Any]) -> None:
    """Raise ConfigError, in one line, for an entry by dotted key that cannot be one."""
    nested: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        table, _, name = key.partition(".")
        nested.setdefault(table, {})[name] = value
    try:
        _Tables.model_validate(nested)
    except ValidationError as error:
        raise ConfigError(f"entry of the record: {say(error.errors(), nested, _Tables)}") from error


def missing(profile: Profile, values: Mapping[str, object]) -> tuple[str, ...]:
    """Return the keys that a profile asks the operator for and `values` does not have."""
    return tuple(key for key in ASKED[profile] if not is_told(values.get(key)))

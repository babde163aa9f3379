"""Is all there that the legal record of an application wants from the operator."""

from __future__ import annotations

from companion.config import Config
from companion.config.application_table import missing, told, zone_named
from companion.doctor.check import Check, not_applicable, ok, warn

NAME = "application-record"


def application_check(config: Config) -> Check:
    """Return whether the record of the chosen profile could be complete after this flight."""
    table = config.application
    if config.output.kind == "none" or config.journal.training:
        return not_applicable(NAME, "training: no product is applied")
    if table.profile is None:
        return warn(
            NAME,
            "application.profile is not set: no legal record is asked for",
            'write profile = "eu", "us" or "generic" under [application]',
        )
    absent = missing(table.profile, told(config))
    if absent:
        return warn(
            NAME,
            f"{table.profile}: missing: {', '.join(absent)}",
            "write them before the flight; docs/application-record.md has all",
        )
    if table.time_zone is not None and zone_named(table.time_zone) is None:
        return warn(
            NAME,
            f"application.time_zone = {table.time_zone}: no time zone that this computer knows",
            "write one such as Europe/Madrid",
        )
    return ok(NAME, f"{table.profile}: all there that the operator must say")

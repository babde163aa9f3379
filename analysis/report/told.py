"""What people said for the record: before the flight by the configuration, after it by options.

What is said afterwards is marked so for good: an inspector sees which entries are as old as the
flight and which are not.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from companion.config.application_table import check, is_number, is_told, known
from companion.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

TABLES = ("application", "product")
SIZE_MAX_BYTES = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """Values by dotted key, such as `application.customer`; `after` names those said afterwards.

    `before` has what the journal said instead, of those that were corrected.
    """

    values: Mapping[str, Any]
    after: frozenset[str]
    before: Mapping[str, Any]


def told_in(meta: Mapping[str, str]) -> dict[str, Any]:
    """Return what the journal itself says; of older ones, what its configuration's text says."""
    try:
        if "application_json" in meta:
            found = json.loads(meta["application_json"])
        else:
            found = _flat(tomllib.loads(meta.get("config_toml", "")))
    except ValueError:  # a damaged text: nothing was said
        return {}
    if not isinstance(found, dict):
        return {}
    return {key: value for key, value in found.items() if is_told(value) and _is_entry(key, value)}


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
    meta: Mapping[str, str], *, file: Path | None = None, changes: Sequence[str] = ()
) -> Told:
    """Return what was said in all; ConfigError, in one line, for what cannot be an entry."""
    before = told_in(meta)
    later = {} if file is None else _read(file)
    later |= dict(_parsed(change) for change in changes)
    values = {**before, **later}
    check(later)
    after = {key for key, value in later.items() if before.get(key) != value}
    return Told(
        values={key: value for key, value in values.items() if is_told(value)},
        after=frozenset(after),
        before={key: before[key] for key in after & before.keys()},
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
    try:
        if file.stat().st_size > SIZE_MAX_BYTES:
            raise ConfigError(f"{file}: too large; give a .toml file with [application]")
        document = tomllib.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise ConfigError(f"{file}: {reason}; give a .toml file with [application]") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: is no TOML file: {' '.join(str(error).split())}") from error
    found = _flat(document)
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
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return key, text
    value = parsed["value"] if list(parsed) == ["value"] else text
    # A certificate's number and a growth stage are digits, and no numbers.
    return key, value if isinstance(value, str) or is_number(key) else text

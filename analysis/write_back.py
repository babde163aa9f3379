"""`calibrate ... --write`: put what was measured into the configuration, and keep all else in it.

The file is edited line by line, so that comments and order stay. What comes of it is read again:
it must be the old configuration with the measured keys changed, and one that can be loaded.
"""

from __future__ import annotations

import copy
import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.atomic_write import write_atomically
from companion.cli.answer import answer, note
from companion.config import load
from companion.errors import ConfigError

_HEADER = re.compile(r"\s*\[(\[?)\s*([A-Za-z0-9_]+)\s*\]")
_KEY = re.compile(r"\s*([A-Za-z0-9_]+)\s*=")
# A set with measured points has no published law any more, and what was weighed is new.
_REPLACED = {"nozzle_set": ("preset", "weighed_duty")}
# What `config new` guesses, and what stands there once it was measured.
_GUESS, _MEASURED = "# MEASURE", "# Measured by `vrspray calibrate`"
# A second taken for a minute is far from this, wear and another nozzle are within it.
CHANGE_MAX = 2.0
# What tells the tables of a list apart.
_NAMED_BY = {"nozzle_set": "valves", "valve": "name"}


Write = Annotated[
    bool, typer.Option("--write", help="Put the result into --config; the old file stays as .bak.")
]


Confirmed = Annotated[
    bool,
    typer.Option("--confirm", help="Take flows of over twice, or under half, what --config has."),
]


def check_change(config: Path | None, measured: str, *, is_confirmed: bool) -> None:
    """Refuse flows that are far from the configured ones, unless that is confirmed."""
    if config is None or is_confirmed:
        return
    load(config)
    old = tomllib.loads(config.read_text(encoding="utf-8-sig"))
    for name, given in tomllib.loads(measured).items():
        for each in given if isinstance(given, list) else [given]:
            there = old.get(name, {})
            if isinstance(there, list):
                key = _NAMED_BY[name]
                there = next((one for one in there if set(one[key]) == set(each[key])), {})
            was, now = (max(one.get("flow_l_min", (0.0,))) for one in (there, each))
            if was > 0.0 and not was / CHANGE_MAX <= now <= was * CHANGE_MAX:
                raise ConfigError(
                    f"measured up to {now:.4g} L/min, but {config} has {was:.4g}: look at seconds, "
                    "units and --times; if it is right, add --confirm"
                )


def check_asked(config: Path | None, *, is_write: bool) -> None:
    """Refuse `--write` without a file to write to."""
    if is_write and config is None:
        raise ConfigError("--write: name the configuration to change with --config FILE")


def written_lines(config: Path | None, result: dict[str, Any], *, is_write: bool) -> list[str]:
    """Write what was measured, if it is asked for; return what changed, for a person."""
    if not is_write or config is None:
        return []
    result["written"] = write_back(config, result["toml"])
    return ["", f"written: {config} (as it was: {config}.bak)", *result["written"]]


def tell_measured(
    config: Path | None,
    result: dict[str, Any],
    lines: Iterable[str],
    *,
    is_write: bool,
    as_json: bool,
) -> None:
    """Write what was measured, if it is asked for, and print it with what changed and warnings."""
    answer(result, [*lines, *written_lines(config, result, is_write=is_write)], as_json=as_json)
    for warning in result["warnings"]:
        note(f"warning: {warning}")


def write_back(config: Path, measured: str) -> list[str]:
    """Put measured tables into a configuration; return the change as lines of a diff.

    `measured` is TOML, as it would be pasted. The file as it was stays beside it, as `.bak`.

    Raises:
        ConfigError: where the file cannot be changed so; it is as it was then.
    """
    load(config)
    before = config.read_text(encoding="utf-8-sig")
    tables = tomllib.loads(measured)
    if "lag" in tables:
        tables.setdefault("lag", {})["measured_on"] = _today()
    after = _edited(before, tables, config)
    if tomllib.loads(after) != _wanted(tomllib.loads(before), tables, config):
        raise ConfigError(f"{config}: cannot be changed line by line; paste the figures yourself")
    draft = config.with_name(f".{config.name}.{os.getpid()}.toml")
    try:
        write_atomically(draft, after.encode())
        load(draft)
        write_atomically(config.with_name(f"{config.name}.bak"), before.encode())
        write_atomically(config, after.encode(), mode=config.stat().st_mode & 0o777)
    except ConfigError as error:
        text = str(error).replace(str(draft), str(config))
        raise ConfigError(f"not written: {text}") from error
    except OSError as error:
        reason = (error.strerror or "cannot be written").lower()
        raise ConfigError(f"{config}: not written: {reason}") from error
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
    return list(
        difflib.unified_diff(
            before.splitlines(), after.splitlines(), f"{config}.bak", str(config), lineterm="", n=1
        )
    )


def _today() -> str:
    return datetime.now(tz=UTC).astimezone().date().isoformat()


def _wanted(old: dict[str, Any], tables: Mapping[str, Any], config: Path) -> dict[str, Any]:
    """Return the old document with what was measured in it."""
    new = copy.deepcopy(old)
    for name, given in tables.items():
        if not isinstance(given, list):
            new.setdefault(name, {}).update(given)
            continue
        for each in given:
            there = new[name][_place(old, name, each, config)]
            there.update({key: value for key, value in each.items() if key != _NAMED_BY[name]})
            for key in _dropped(name, each):
                there.pop(key, None)
    return new


def _dropped(name: str, each: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys that no longer hold once a table was measured anew."""
    return tuple(key for key in _REPLACED.get(name, ()) if key not in each)


def _place(old: Mapping[str, Any], name: str, each: Mapping[str, Any], config: Path) -> int:
    """Return which of the tables in a list is the measured one: by its valves, or its name."""
    key = _NAMED_BY[name]
    for number, there in enumerate(old.get(name, [])):
        if set(there.get(key, [])) == set(each.get(key, [])):
            return number
    valves = ", ".join(each.get("valves", [])) or "not named"
    if key == "name":
        raise ConfigError(f"{config}: has no [[{name}]] called {each[key]!r}")
    raise ConfigError(
        f"{config}: has no [[{name}]] of these valves ({valves}); write one, or name them in the "
        "column set"
    )


def _edited(before: str, tables: Mapping[str, Any], config: Path) -> str:
    old, lines = tomllib.loads(before), before.splitlines()
    for name, given in tables.items():
        if not isinstance(given, list):
            _set(lines, name, 0, given)
            continue
        for each in given:
            number = _place(old, name, each, config)
            keys = {key: value for key, value in each.items() if key != _NAMED_BY[name]}
            _set(lines, name, number, keys, drop=_dropped(name, each))
    return "\n".join(lines) + "\n"


def _set(
    lines: list[str],
    name: str,
    number: int,
    given: Mapping[str, Any],
    *,
    drop: tuple[str, ...] = (),
) -> None:
    """Change the keys of one table in place; add what is not there."""
    begin = next((at for count, at in enumerate(_headers(lines, name)) if count == number), None)
    if begin is None:
        lines += ["", f"[{name}]"]
        begin = len(lines) - 1
    for key, value in given.items():
        _set_key(lines, begin, key, f"{key} = {_text(value)}")
    for key in drop:
        found = _span(lines, begin, key)
        if found is not None:
            del lines[found[0] : found[1]]
    _say_measured(lines, begin, name)


def _say_measured(lines: list[str], begin: int, name: str) -> None:
    """Put what is so now in the place of a comment above a table that called it a guess."""
    first = begin
    while first and lines[first - 1].startswith("#"):
        first -= 1
    block = lines[first:begin]
    old = [at for at, line in enumerate(block) if line.startswith((_GUESS, _MEASURED))]
    if old or name in ("nozzle_set", "pump"):
        kept = block[: old[0]] if old else block
        lines[first:begin] = [*kept, f"{_MEASURED}, {_today()}."]


def _headers(lines: list[str], name: str) -> Iterator[int]:
    for at, line in enumerate(lines):
        match = _HEADER.match(line)
        if match is not None and match[2] == name:
            yield at


def _set_key(lines: list[str], begin: int, key: str, text: str) -> None:
    found = _span(lines, begin, key)
    if found is None:
        lines.insert(_end(lines, begin), text)
        return
    first, last = found
    comment = ""
    if last == first + 1 and '"' not in lines[first]:
        _, hash_sign, words = lines[first].partition("#")
        comment = f"  #{words}" if hash_sign else ""
    lines[first:last] = [text + comment]


def _end(lines: list[str], begin: int) -> int:
    """Return where a key can be added to a table: behind its last one."""
    end = begin + 1
    for at in range(begin + 1, len(lines)):
        if _HEADER.match(lines[at]):
            break
        if _KEY.match(lines[at]):
            found = _span(lines, begin, _key_of(lines[at]))
            end = at + 1 if found is None else found[1]
    return end


def _key_of(line: str) -> str:
    match = _KEY.match(line)
    return "" if match is None else match[1]


def _span(lines: list[str], begin: int, key: str) -> tuple[int, int] | None:
    """Return the lines of a key in the table that begins at a line; a list may have several."""
    for at in range(begin + 1, len(lines)):
        if _HEADER.match(lines[at]):
            return None
        if _key_of(lines[at]) != key:
            continue
        for last in range(at + 1, len(lines) + 1):
            with suppress(tomllib.TOMLDecodeError):
                tomllib.loads("\n".join(lines[at:last]))
                return at, last
    return None


def _text(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_text(each) for each in value)}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)

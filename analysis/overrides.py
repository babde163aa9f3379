"""Changes of a recorded set-up for a what-if: KEY=VALUE on the fields of `Setup`.

Keys are those of the configuration file where the set-up has them ("lag.on_s", "safety.modes",
"prescription.border"), or the dotted path of a field of `Setup` ("nozzle_sets.0.valves").
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from companion.core.setup import Setup
from companion.errors import ConfigError

# Where the configuration file and the set-up name the same thing differently.
_ALIASES = {
    "lag.method": "method",
    "prescription.border": "border",
    "prescription.border_buffer_m": "border_buffer_m",
    "prescription.across": "across",
    "output.lease_s": "lease_s",
    "mission.lines_aside_m": "lines.aside_m",
    "mission.lines_course_deg": "lines.course_deg",
}
_PREFIXES = {"safety.": "limits."}
_FIXED = ("frame", "prescription")
_YES, _NO = ("true", "yes", "1"), ("false", "no", "0")


def override(setup: Setup, changes: Sequence[str]) -> Setup:
    """Return `setup` with every KEY=VALUE carried out; ConfigError for what cannot be."""
    for change in changes:
        key, equals, text = change.partition("=")
        key, text = key.strip(), text.strip()
        if not (key and equals):
            raise ConfigError(f"--set {change}: write KEY=VALUE, such as lag.on_s=0.12")
        path = _path(key)
        if path[0] in _FIXED:
            raise ConfigError(f"--set {key}: the ground of a recorded flight cannot be changed")
        try:
            setup = _replaced(setup, path, text, Setup)
        except (ValueError, TypeError) as error:
            raise ConfigError(f"--set {change}: {error}") from error
    return setup


def _path(key: str) -> list[str]:
    key = _ALIASES.get(key, key)
    for prefix, own in _PREFIXES.items():
        if key.startswith(prefix):
            key = own + key.removeprefix(prefix)
    return key.split(".")


def _replaced(value: Any, path: Sequence[str], text: str, hint: Any) -> Any:
    """Return `value` with the field at `path` replaced by what `text` says."""
    if not path:
        return _parsed(text, hint)
    name, rest = path[0], path[1:]
    if isinstance(value, tuple):
        if not (name.isdigit() and int(name) < len(value)):
            raise ValueError(f"{name} is no index of {len(value)} values, counted from 0")
        i = int(name)
        return (*value[:i], _replaced(value[i], rest, text, get_args(hint)[0]), *value[i + 1 :])
    if not is_dataclass(value) or isinstance(value, type):
        raise ValueError(f"there is nothing below it called {name}")
    known = [field.name for field in fields(value) if field.init]
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise ValueError(
            f"{name} is unknown; " + (f"{near[0]}?" if near else f"known: {', '.join(known)}")
        )
    inner = get_type_hints(type(value))[name]
    return replace(value, **{name: _replaced(getattr(value, name), rest, text, inner)})


def _parsed(text: str, hint: Any) -> Any:
    """Return the value of type `hint` that `text` stands for; ValueError where it is none."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _parsed_union(text, get_args(hint))
    if origin is Literal:
        return _one_of(text, {str(value): value for value in get_args(hint)})
    if origin in (tuple, frozenset):
        inner = get_args(hint)[0]
        words = text.strip("[]()").replace('"', "").replace("'", "").split(",")
        return origin(_parsed(word.strip(), inner) for word in words if word.strip())
    if hint is bool:
        return _one_of(text.lower(), dict.fromkeys(_YES, True) | dict.fromkeys(_NO, False))
    if isinstance(hint, type) and issubclass(hint, Enum):
        # As the configuration file writes them: rtk-float, 3d, look-ahead.
        names = {
            member.name.lower().replace("_", "-").removeprefix("fix-"): member for member in hint
        }
        return _one_of(text, names)
    if hint in (float, int, str):
        return hint(text)
    raise ValueError("name one of its fields")


def _parsed_union(text: str, hints: tuple[Any, ...]) -> Any:
    if NoneType in hints and text.lower() == "none":
        return None
    return _parsed(text, next(hint for hint in hints if hint is not NoneType))


def _one_of(text: str, known: dict[str, Any]) -> Any:
    if text not in known:
        raise ValueError(f"{text} is none of {', '.join(known)}")
    return known[text]

"""Reading a configuration file, and saying in one line what is wrong with it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from datetime import date, time
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from companion.config.document import Origin, leaves
from companion.config.model import Config
from companion.errors import ConfigError
from companion.wording import say_syntax, show_value

# A configuration is a page of text; whatever is larger is another file, given by mistake.
SIZE_MAX_BYTES = 1_000_000
STEP = re.compile(r"([A-Za-z0-9_-]+)((?:\[\d+\])*)")


def load(path: Path, *, overrides: Sequence[str] = ()) -> Config:
    """Return the configuration in `path`, with `overrides` such as "lag.on_s=0.12" on top.

    Raises:
        ConfigError: in one line: file, key, value, what to write instead.
    """
    text = _read(path)
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(say_syntax(path, text, str(error))) from error
    except RecursionError as error:
        raise ConfigError(f"{path}: brackets nested too deep; write plain tables") from error
    origins: dict[str, Origin] = {key: "file" for key, _ in leaves(raw)}
    for override in overrides:
        origins.update((key, "override") for key in _apply(raw, override))
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        from companion.config.wording import findings, one_line

        found = findings(error.errors(), raw, Config)
        raise ConfigError(
            f"{path}: {one_line(found)}", problems=[each.problem() for each in found]
        ) from error
    name, label = config.limits_table.file, None
    if name is not None:
        from companion.config.limits import read_limits

        label = read_limits(path.parent / name, f"{path}: limits.file: {path.parent / name}")
    return config.came_from(path, source_text=text, origins=origins, label=label)


def _read(path: Path) -> str:
    """Return the text of the file."""
    try:
        if path.stat().st_size > SIZE_MAX_BYTES:
            raise ConfigError(f"{path}: too large for a configuration; give the .toml file")
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        reason = (error.strerror or "cannot be read").lower()
        raise ConfigError(f"{path}: {reason}; give the path of a configuration file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: not UTF-8 text (byte {error.start}); save the file as UTF-8"
        ) from error


def _apply(raw: dict[str, Any], override: str) -> list[str]:
    """Set what `override` says in `raw` and return the keys that it set."""
    key, equals, value_text = override.partition("=")
    key = key.strip()
    steps = _steps(key)
    if not equals or not steps:
        raise ConfigError(
            f"override {show_value(override)}: no setting; write KEY=VALUE such as lag.on_s=0.12"
        )
    value = parse_value(value_text.strip())
    node: Any = raw
    for step, following in zip(steps, [*steps[1:], None], strict=True):
        if isinstance(step, int) and not (isinstance(node, list) and step < len(node)):
            raise ConfigError(f"override {key}: there is no entry [{step}]; count from 0")
        if isinstance(step, str) and not isinstance(node, dict):
            raise ConfigError(f"override {key}: {step} stands in no table; see `config show`")
        if following is None:
            node[step] = value
        elif isinstance(step, str):
            node = node.setdefault(step, {})
        else:
            node = node[step]
    return [leaf for leaf, _ in leaves(value, key)]


def _steps(key: str) -> list[str | int]:
    """Return the names and indices of a dotted key; nothing when it is none.

    >>> _steps("valve[2].right_m")
    ['valve', 2, 'right_m']
    """
    steps: list[str | int] = []
    for part in key.split("."):
        match = STEP.fullmatch(part)
        if match is None:
            return []
        steps.append(match[1])
        steps.extend(int(index) for index in re.findall(r"\d+", match[2]))
    return steps


def parse_value(text: str) -> Any:
    """Return what follows `--set KEY=` as TOML has it; what it does not know is text, and a time.

    >>> [parse_value(text) for text in ("0.12", "none", '["AUTO"]', "2026-05-01T06:30:00Z")]
    [0.12, 'none', ['AUTO'], '2026-05-01T06:30:00Z']
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    is_value = list(parsed) == ["value"] and not isinstance(parsed["value"], date | time)
    return parsed["value"] if is_value else text

"""Options that several commands have in common, as one parameter of each."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, NamedTuple

REQUIRED = inspect.Parameter.empty


class Option(NamedTuple):
    """One option as Typer takes it: its annotation, and its default."""

    kind: Any
    default: Any = None


def with_options(
    parameter: str, options: Mapping[str, Option], make: Callable[..., Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command `options` in the place of `parameter`.

    What `make` puts together of their values is what the command gets for it.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command, eval_str=True)
        own = [item for item in signature.parameters.values() if item.name != parameter]
        added = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=each.default, annotation=each.kind
            )
            for name, each in options.items()
        ]

        @wraps(command)
        def expanded(**given: Any) -> None:
            values = {name: given.pop(name) for name in options}
            command(**{parameter: make(**values)}, **given)

        # Typer reads it; the type of a function does not know it.
        expanded.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=[item.replace(kind=inspect.Parameter.KEYWORD_ONLY) for item in own] + added
        )
        expanded.__annotations__ = {item.name: item.annotation for item in [*own, *added]}
        return expanded

    return decorate

"""Sub-commands of `vrspray`: those of other packages announce themselves by entry points.

Nobody here knows who they are: a distribution names its commands in the group `vrspray.commands`
of its entry points, and each is imported when it is asked for (docs/contributing/commands.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any, Literal

from companion.errors import VrsprayError
from companion.wording import missing

GROUP = "vrspray.commands"
# Whose commands come first where two distributions name the same one.
_OURS = "vrspray"

# How a command does beside a flight on the same computer: at once, at low priority, or at low
# priority and so short that nothing need be said about it.
Haste = Literal["at-once", "patient", "quick"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A sub-command that is not imported yet.

    `target` is where it is, `module:attribute`: a Typer application or a function. `help` is its
    line in the list of all commands. `hastes` are exceptions, by the names of its own commands.
    """

    target: str
    help: str
    haste: Haste = "at-once"
    hastes: Mapping[str, Haste] = field(default_factory=dict)

    def haste_of(self, name: str) -> Haste:
        """Return the haste of one of its own commands."""
        return self.hastes.get(name, self.haste)


def registered(under: str = "") -> dict[str, EntryPoint]:
    """Return the commands of all installed distributions by their names; none is imported.

    With `under` those that stand below a command of ours: `flights.show` is `show` of `flights`.
    """
    found: dict[str, EntryPoint] = {}
    for point in _points():
        group, _, name = point.name.rpartition(".")
        # Whose it is takes long to read, and matters only where two name the same one.
        if group == under and (name not in found or _is_ours(point)):
            found[name] = point
    return dict(sorted(found.items()))


@cache
def _points() -> tuple[EntryPoint, ...]:
    # Looks through all that is installed: a command asks several times who is there.
    return tuple(entry_points(group=GROUP))


def _is_ours(point: EntryPoint) -> bool:
    return point.dist is not None and point.dist.name == _OURS


def is_there(name: str) -> bool:
    """Tell whether a command is registered and its package is installed."""
    point = registered().get(name)
    try:
        return point is not None and find_spec(point.module) is not None
    except (ImportError, ValueError):
        return False


def load(name: str, target: str | EntryPoint) -> Any:
    """Return what a `module:attribute` or an entry point names.

    Raises:
        VrsprayError: where it is not installed.
    """
    try:
        # Not by its class: some libraries put another one in the place of the standard one.
        if not isinstance(target, str):
            return target.load()
        module_name, _, attribute = target.partition(":")
        return getattr(import_module(module_name), attribute)
    except ModuleNotFoundError as error:
        raise VrsprayError(
            f"vrspray {name}: {missing(str(error.name).partition('.')[0])}"
        ) from error
    except (ImportError, AttributeError) as error:
        raise VrsprayError(
            f"vrspray {name}: cannot be loaded ({error}); install its distribution again"
        ) from error


def command_named(name: str, under: str = "") -> Command | None:
    """Return what a registered command says of itself; None where nothing of this name is."""
    point = registered(under).get(name)
    return None if point is None else _announced(name, point)


def _announced(name: str, point: EntryPoint) -> Command:
    found = load(name, point)
    if isinstance(found, Command):
        return found
    # A Typer application, or a function: what it says itself.
    info = getattr(found, "info", None)
    said = getattr(info, "help", None) or getattr(found, "__doc__", None)
    is_function = not hasattr(found, "registered_commands")
    text = said if isinstance(said, str) and (is_function or info is not None) else ""
    return Command(target=point.value, help=text.strip().partition("\n")[0])


def all_registered(under: str = "") -> dict[str, Command]:
    """Return all registered commands by their names, for a list of them.

    One that cannot be loaded stands in it all the same.
    """
    found = {}
    for name, point in registered(under).items():
        try:
            found[name] = _announced(name, point)
        except VrsprayError as error:
            found[name] = Command(target=point.value, help=f"({error})")
    return found

"""The field that is flown: the configuration's own, or one that was chosen on the operator's page.

The page only proposes. The run takes a proposal on the ground, with all closed, keeps it in the
state folder, and ends, for what started it to start it anew: only that start finds another field.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.config import Config
from companion.core.types import Decision
from companion.errors import ConfigError
from companion.web import Order, Outcome

PROPOSED_NAME, CHOSEN_NAME = "field-proposed.json", "field.json"
KEYS = frozenset(
    {
        *("prescription.file", "prescription.boundary", "prescription.exclusions", "mission.lines"),
        *("prescription.rate_field", "prescription.unit", "prescription.crs", "prescription.layer"),
    }
)
# A service says by it that it starts a run anew that ends with this status.
RESTARTS, RESTART = "VRSPRAY_RESTARTS", 75
BYTES_MAX = 10_000
HEARD_S = 2.5


def read_choice(path: Path) -> tuple[str, tuple[str, ...]]:
    """Return the name of a field, and as overrides what names its files; nothing without a file.

    Raises:
        ConfigError: a choice that cannot be read is not the configuration's own field either.
    """
    try:
        with path.open("rb") as file:
            found = json.loads(file.read(BYTES_MAX))
        name, settings = str(found["field"]), dict(found["settings"])
        if "prescription.file" not in settings or not KEYS.issuperset(settings):
            raise ValueError("not what the page writes")
        return name, tuple(f"{key}={value}" for key, value in settings.items())
    except FileNotFoundError:
        return "", ()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: names no field ({error}); delete it to fly the configuration's own"
        ) from error


def no_choice(config: Config, given: Sequence[str]) -> str:
    """Return why no field can be chosen on the page; nothing where one can.

    `given` are the overrides of the start: they count more than any choice.
    """
    if not config.web.choose_field:
        return "set web.choose_field = true to fly it from here"
    named = [item for item in given if item.partition("=")[0] in KEYS]
    if named:
        return f"the command that starts run names the field: --set {named[0]}"
    if os.environ.get(RESTARTS) != str(RESTART):
        return "to fly it from here, have a service start run (vrspray service install)"
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldChoice:
    """Takes what the page proposes; `newest` is the last decision, `end` ends the run."""

    folder: Path
    refusal: str
    newest: Callable[[], Decision | None]
    end: Callable[[], None]

    def obey(self, order: Order, now_s: float) -> Outcome:
        """Take a field that was proposed, or with no name the configuration's own, and end."""
        name = str(dict(order.said).get("field", ""))
        refusal = self.refusal or _not_now(self.newest(), now_s)
        if refusal:
            return Outcome(accepted=False, text=refusal)
        kept, proposed = self.folder / CHOSEN_NAME, self.folder / PROPOSED_NAME
        try:
            if not name:
                kept.unlink(missing_ok=True)
            elif read_choice(proposed)[0] == name:
                proposed.replace(kept)
            else:
                return Outcome(accepted=False, text="another field was proposed: choose again")
        except (ConfigError, OSError) as error:
            return Outcome(accepted=False, text=str(error))
        self.end()
        return Outcome(accepted=True, text="the companion starts again")


def _not_now(decision: Decision | None, now_s: float) -> str:
    """Return why the field must stay as it is; nothing on the ground, disarmed, all closed."""
    state = None if decision is None else decision.state
    if decision is None or state is None or state.heartbeat_received_s is None:
        return "the vehicle is not heard: is it on the ground?"
    if not 0.0 <= now_s - state.heartbeat_received_s <= HEARD_S:
        return "the vehicle is not heard: is it on the ground?"
    if state.armed is not False or state.in_air or not decision.plan.is_off:
        return "land and disarm first"
    return ""

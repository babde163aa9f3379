"""Errors that the application raises on purpose.

    VrsprayError
     +-- ConfigError      the operator's file is wrong: the message names file, key, value and fix
     +-- MapError         a prescription cannot be used
     +-- StoppedError     the user interrupted work that is kept
     +-- LinkError        the link to the autopilot cannot be opened or was lost
     +-- ActuatorError    the valve driver refused or did not answer
     +-- SensorError      a sensor that the configuration names is not to be had
     +-- JournalError     a journal cannot be opened, read or written
          +-- UnreadableError  a journal, of which what is asked for cannot be read
               +-- NoMapError  its map is damaged: the rest can be read
               +-- OtherVersionError  its version is not known (journal/reader.py)

A wrong argument inside our own code is a `ValueError`: a bug, not a condition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong or remarkable, where it is, and what the operator can do."""

    severity: Severity
    code: str
    text: str
    where: str = ""
    fix: str = ""

    def __post_init__(self) -> None:
        if self.severity not in ("error", "warning"):
            raise ValueError(f"no severity: {self.severity}")


# What the command line says of a `MemoryError`.
NOT_ENOUGH_MEMORY = "not enough memory; use a smaller file or another computer"


class VrsprayError(Exception):
    """Base of all errors that the command line reports in one line, without a traceback."""


class ConfigError(VrsprayError):
    """The configuration file cannot be used.

    `problems` is all that is wrong with its settings, where more than one thing may be.
    """

    def __init__(self, text: str, *, problems: Sequence[Problem] = ()) -> None:
        super().__init__(text)
        self.problems = tuple(problems)


class MapError(VrsprayError):
    """A prescription, boundary or exclusion file cannot be used.

    `code` is the linter's name of the reason (docs/reference/map-problems.md), `fix` what the
    operator can do.
    """

    def __init__(self, text: str, *, code: str = "unusable", fix: str = "") -> None:
        super().__init__(text)
        self.code = code
        self.fix = fix


class StoppedError(VrsprayError):
    """The user interrupted; the message says what is kept and how it goes on."""


class LinkError(VrsprayError):
    """The link to the autopilot cannot be opened or was lost."""


class ActuatorError(VrsprayError):
    """The valve driver refused an order or did not answer."""


class SensorError(VrsprayError):
    """A sensor that the configuration names cannot be opened."""


class JournalError(VrsprayError):
    """A journal cannot be opened, read or written."""


class UnreadableError(JournalError):
    """A journal is damaged, or of another version: what is asked for cannot be read of it."""


class NoMapError(UnreadableError):
    """The map in a journal is damaged; the message says what else can be read."""

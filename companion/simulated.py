"""Whether a flight was real or simulated: what is known of it, and what told.

One word and one reason travel together from the link into the journal, and from there into every
page, export and record. What is not known says so: a guess in either direction does harm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

Word = Literal["yes", "no", "unknown"]
# The kind of event that carries it into the journal, and the keys of `meta`.
SIMULATED, BECAUSE = "simulated", "simulated_because"
_BECAUSE_MAX = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulated:
    """Whether a flight was simulated; `is_unmarked`: the journal is older than this mark."""

    word: Word
    because: str
    is_unmarked: bool = False

    @property
    def is_simulated(self) -> bool:
        """Return whether the flight is known to have been a simulation."""
        return self.word == "yes"

    @property
    def is_known(self) -> bool:
        """Return whether it is known at all."""
        return self.word != "unknown"

    @property
    def text(self) -> str:
        """Return word and reason, as an event of the journal has them.

        >>> Simulated(word="no", because="real sensors").text
        'no: real sensors'
        """
        return f"{self.word}: {self.because}"

    @property
    def label(self) -> str:
        """Return the mark for a title or a line; empty for a real flight.

        >>> Simulated(word="yes", because="a twin").label
        'SIMULATED'
        >>> Simulated(word="unknown", because="nobody told").label
        'not known whether simulated'
        """
        return {"yes": "SIMULATED", "no": "", "unknown": "not known whether simulated"}[self.word]


NOT_ASKED = Simulated(word="unknown", because="no autopilot has said so")
UNMARKED = Simulated(
    word="unknown", because="the journal is older than this mark", is_unmarked=True
)


def parsed(text: str) -> Simulated:
    """Return what a text of an event says; anything else is not known.

    >>> parsed("yes: a simulated gyro").is_simulated, parsed("perhaps").word
    (True, 'unknown')
    """
    word, _, because = text.partition(": ")
    for known in get_args(Word):
        if word == known:
            return Simulated(word=known, because=because[:_BECAUSE_MAX])
    return Simulated(word="unknown", because="the mark cannot be read")


def simulated_in(meta: Mapping[str, str]) -> Simulated:
    """Return what a journal's `meta` says; the twin's journals said it by their training first."""
    if meta.get("training") == SIMULATED:
        return Simulated(
            word="yes", because=meta.get(BECAUSE, "the journal was made by a simulation")
        )
    if SIMULATED not in meta:
        return UNMARKED
    return parsed(f"{meta[SIMULATED]}: {meta.get(BECAUSE, '')}")

"""What is written down besides inputs and decisions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What happened besides inputs and decisions."""

    at_s: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSample:
    """How the link does at one moment: a value for each column of `link_stats`, as far as known."""

    at_s: float
    values: Mapping[str, float | None]

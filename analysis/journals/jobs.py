"""Which journals are sorties of one job: one field, sprayed in several flights.

Only the id that a plan wrote into its lines joins by itself. Flights of one map within two days may
be of a job, or its second treatment: they are named, and joined by nobody but the user.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from analysis.journals.content import content_sha256
from companion.errors import ConfigError, JournalError, VrsprayError
from companion.flight_map import JOB_KEY
from companion.journal.folder import journals
from companion.journal.reader import opened
from companion.simulated import simulated_in

NEAR_S = 48 * 3600.0
# Who flies a plan again after so long treats the field again.
PAUSE_MAX_S = 7 * 86_400.0
# So many journals before and behind one are looked at.
LOOKED_AT = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Sortie:
    """What a journal says of itself."""

    path: Path
    meta: Mapping[str, str] = field(compare=False)

    @property
    def job(self) -> str | None:
        """Return the id of the plan that was flown; None without one, as in old journals."""
        try:
            return str(json.loads(self.meta["flight_map_json"])["frozen"][JOB_KEY])
        except (ValueError, TypeError, LookupError, RecursionError):
            return self.meta.get(JOB_KEY)  # of a simulated flight, which freezes no map

    @property
    def began_s(self) -> float:
        """Return when it began, in seconds since 1970."""
        return float(self.meta["started_s"]) + float(self.meta["utc_offset_s"])

    @property
    def ground(self) -> tuple[str | None, ...]:
        """Return what all sorties of a job have in common: map, place, what was sprayed."""
        keys = ("map_sha256", "origin_latitude_deg", "origin_longitude_deg", "training")
        return (*map(self.meta.get, keys), simulated_in(self.meta).word)


def sortie_of(path: Path) -> Sortie:
    """Return what a journal says of itself; JournalError where it is none, or still written."""
    with opened(path, is_lenient=True) as journal:
        return Sortie(path=path, meta=journal.meta)


def one_job(paths: Sequence[Path]) -> list[Sortie]:
    """Return the sorties in order of time; ConfigError where they are not of one field."""
    found = sorted(map(sortie_of, paths), key=lambda each: each.began_s)
    seen: dict[str, Path] = {}
    first = found[0]
    for each in found:
        sha256 = content_sha256(each.path)
        if sha256 in seen:
            raise ConfigError(f"{each.path}: the same flight as {seen[sha256]}; name one of them")
        seen[sha256] = each.path
        for what, its, other in zip(
            ("map", "place", "place", "training", "simulation"),
            each.ground,
            first.ground,
            strict=True,
        ):
            if its != other or (what == "map" and not its):
                raise ConfigError(
                    f"{each.path}: was flown with another {what} than {first.path} ({str(its)[:12]}"
                    f", not {str(other)[:12]}): no sorties of one job; report each by itself"
                )
        if None not in (each.job, first.job) and each.job != first.job:
            raise ConfigError(
                f"{each.path}: is of job {each.job}, {first.path} of job {first.job}; report each "
                "job by itself"
            )
    return found


def joined(given: Sequence[Sortie]) -> tuple[list[Sortie], list[Sortie]]:
    """Return the given sorties with those of their job, by its id, and others that may be of it.

    They are looked for beside the given ones.
    """
    every = _beside(given)
    job = next((each.job for each in given if each.job is not None), None)
    own = [each for each in every if job is not None and each.job == job]
    found = _near(given, own, PAUSE_MAX_S)
    alike = [each for each in every if each.job is None or job is None]
    both = _near(found, alike, NEAR_S)
    return found, [each for each in both if each not in found]


def _beside(given: Sequence[Sortie]) -> list[Sortie]:
    """Return the flights of the same ground in the folders of the given ones."""
    found = []
    for folder in {each.path.parent for each in given}:
        try:
            paths = journals(folder)
        except JournalError:
            continue
        at = [number for number, path in enumerate(paths) if path in {s.path for s in given}]
        for path in paths[max(min(at, default=0) - LOOKED_AT, 0) : max(at, default=0) + LOOKED_AT]:
            try:
                each = sortie_of(path)
                is_alike = each.ground == given[0].ground and each.began_s > 0.0
            except (VrsprayError, ValueError, LookupError):
                continue
            found += [each] if is_alike else []
    return found


def _near(given: Sequence[Sortie], others: Sequence[Sortie], within_s: float) -> list[Sortie]:
    """Return the given with all that began so shortly before or after one of them."""
    found = list(given)
    while more := [
        each
        for each in others
        if each not in found and any(abs(each.began_s - one.began_s) <= within_s for one in found)
    ]:
        found += more
    return sorted(found, key=lambda each: each.began_s)


def pauses(sorties: Sequence[Sortie]) -> list[tuple[int, float]]:
    """Return behind which sorties, counted from 1, more days passed than a job takes, and how many.

    The doses of a second treatment would be added to those of the first.
    """
    return [
        (number, (after.began_s - before.began_s) / 86_400.0)
        for number, (before, after) in enumerate(pairwise(sorties), start=1)
        if after.began_s - before.began_s > PAUSE_MAX_S
    ]

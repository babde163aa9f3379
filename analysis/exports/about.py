"""What every export says of itself: which flight, by whose clock, of what, and whether all of it.

A file travels without the journal it came from. Whoever opens it next year must still see that it
was water, that the clock was nobody's, or that the record was cut.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight


import numpy as np
from numpy.typing import NDArray

UNKNOWN = "unknown"
# Of a journal that is older than the mark; its exports stay as they were but for this.
UNMARKED = "unknown: an old journal"


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The facts of a flight that stand in its exports; `training` is `unknown` if nobody said.

    `simulated` is yes, no, or unknown.
    `operator`, `product` and `field_name` are what was asked for before the flight; None without.
    """

    flight: str
    journal: str
    training: str
    simulated: str
    started_utc: str
    ended_utc: str
    utc_source: str
    map_sha256: str
    calibration_sha256: str | None
    operator: str | None
    product: str | None
    field_name: str | None
    is_closed: bool
    lost_rows: int
    recorded_by: str
    exported_by: str

    @property
    def is_training(self) -> bool:
        """Whether it is known that no product was sprayed."""
        return self.training not in ("no", UNKNOWN)

    @property
    def mark(self) -> str:
        """Return what stands in the column `training`: that a flight was simulated goes first."""
        if self.simulated == "yes":
            return "simulated"
        unsure = ", not known whether simulated" if self.simulated == UNKNOWN else ""
        return f"{self.training}{unsure}"

    @property
    def title(self) -> str:
        """Return the name of the flight, with the marks of a simulation and of a training."""
        mark = f" (training: {self.training})" if self.is_training else ""
        return f"{'SIMULATED ' if self.simulated == 'yes' else ''}{self.flight}{mark}"

    def as_json(self) -> dict[str, object]:
        """Return all facts by their names."""
        return {name: getattr(self, name) for name in self.__slots__}

    def as_text(self) -> dict[str, str]:
        """Return all facts that there are, as text."""
        return {
            name: value if isinstance(value, str) else json.dumps(value)
            for name, value in self.as_json().items()
            if value is not None
        }


def about(flight: AppliedFlight) -> About:
    """Return what there is to say of a flight with at least one sample."""
    meta = flight.meta
    asked = _asked_before(meta)
    return About(
        flight=meta.get("flight_id") or flight.path.stem,
        journal=flight.path.name,
        training=flight.training or UNKNOWN,
        simulated=UNMARKED if flight.simulated.is_unmarked else flight.simulated.word,
        started_utc=utc_text(flight.time_s[:1] + flight.utc_offset_s)[0],
        ended_utc=utc_text(flight.time_s[-1:] + flight.utc_offset_s)[0],
        utc_source=flight.utc_source,
        map_sha256=meta.get("map_sha256") or UNKNOWN,
        calibration_sha256=meta.get("calibration_sha256"),
        operator=_text(asked, "application.operator"),
        product=_text(asked, "product.name"),
        field_name=_text(asked, "application.field_name"),
        is_closed=flight.is_closed,
        lost_rows=flight.lost,
        recorded_by=f"vrspray {meta.get('version_vrspray', UNKNOWN)}",
        exported_by=f"vrspray {version('vrspray')}",
    )


def _asked_before(meta: Mapping[str, str]) -> Mapping[str, object]:
    """Return what was told before the flight, by dotted key; nothing where it cannot be read."""
    try:
        found = json.loads(meta.get("application_json") or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _text(values: Mapping[str, object], key: str) -> str | None:
    """Return a text on one line; None where there is none."""
    found = values.get(key)
    if not isinstance(found, str):
        return None
    # JSON can hold half of a pair of UTF-16, which no file of ours can.
    sound = found.encode("utf-8", errors="replace").decode("utf-8")
    return " ".join(sound.split()) or None


# Times as files write them: UTC, ISO 8601, to the millisecond.

Floats = NDArray[np.float64]


def utc_ms(utc_s: Floats) -> NDArray[np.int64]:
    """Return seconds since 1970 as whole milliseconds, to the nearest."""
    found: NDArray[np.int64] = np.rint(np.asarray(utc_s) * 1000.0).astype(np.int64)
    return found


def utc_text(utc_s: Floats) -> list[str]:
    """Return seconds since 1970 as text.

    >>> utc_text(np.array([0.0005, 1774953296.1234]))
    ['1970-01-01T00:00:00.000Z', '2026-03-31T10:34:56.123Z']
    """
    moments = utc_ms(utc_s).astype("datetime64[ms]")
    return [f"{each}Z" for each in np.datetime_as_string(moments, unit="ms").tolist()]

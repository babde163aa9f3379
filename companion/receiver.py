"""How late and how far off a receiver's own positions are beside those that the estimator tells.

How late they are is the delay that the autopilot assumes, which need not be the true one. So this
is shown and steers nothing: whatever decides or sends must not import it (pyproject.toml).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter

from companion.core.frame import METRES_PER_DEGREE
from companion.core.types import Fix, GnssReport, Input, Telemetry

# Receivers are rarely earlier or later, and an estimate farther from one (from RTK) is at fault.
LATE_MIN_S, LATE_MAX_S, OFF_MAX_M, OFF_RTK_M = 0.02, 0.25, 0.5, 0.3
MOVING_M_S = 1.0
# Fewer fixes say nothing; nor do velocities that are all alike, whose way a late place looks like
# an offset: their variance must be 1 m2/s2.
FIXES_MIN, VARIANCE_MIN_M2_S2 = 5, 1.0
# A fix waits for the positions told around it: at 50 Hz those of a second.
TOLD_KEPT = 50
# Between positions farther apart nobody knows the way.
GAP_MAX_S = 1.5
# At 5 Hz a vehicle in flight remembers two minutes.
MEMORY_FIXES = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverOffset:
    """What a receiver's positions differ by; `late_s` is None for a vehicle that stands."""

    late_s: float | None
    off_m: float
    is_rtk: bool

    @property
    def is_unusual(self) -> bool:
        """Whether somebody should look for the reason."""
        is_usual = self.late_s is None or LATE_MIN_S <= self.late_s <= LATE_MAX_S
        return not (is_usual and self.off_m <= (OFF_RTK_M if self.is_rtk else OFF_MAX_M))

    @property
    def words(self) -> str:
        """Return it in words.

        >>> ReceiverOffset(late_s=None, off_m=0.6, is_rtk=True).words
        'receiver 0.60 m beside estimator, which is UNUSUAL'
        """
        behind = f"receiver {self.off_m:.2f} m beside estimator"
        if self.late_s is not None:
            behind = (
                "receiver behind estimator (the delay the autopilot assumes, not a measured one): "
                f"{1000.0 * self.late_s:.0f} ms, {self.off_m:.2f} m beside it"
            )
        return behind + ", which is UNUSUAL" * self.is_unusual


class ReceiverWatch:
    """Compares each fix with what the estimator told for the same time of the autopilot's clock."""

    def __init__(self, memory_fixes: float = math.inf) -> None:
        self._kept = 1.0 - 1.0 / memory_fixes
        self._told: deque[tuple[float, complex, complex]] = deque(maxlen=TOLD_KEPT)
        self._fix = (math.nan, 0j)
        self._is_rtk = False
        # Count; sums of velocity, its square, offset, and their product: east is real, north
        # imaginary. Of a vehicle that stands, and of one in motion.
        self._sums = ([0j] * 5, [0j] * 5)

    def take(self, item: Input) -> None:
        """Take a position of either; nothing of other messages."""
        if isinstance(item, Telemetry):
            north_m_s, east_m_s = item.velocity_north_m_s, item.velocity_east_m_s
            if north_m_s is not None and east_m_s is not None:
                place = item.latitude_deg, item.longitude_deg
                self.told(item.boot_s, *place, north_m_s, east_m_s)
        elif isinstance(item, GnssReport):
            boot_s, latitude_deg, longitude_deg = item.boot_s, item.latitude_deg, item.longitude_deg
            if boot_s is not None and latitude_deg is not None and longitude_deg is not None:
                self.fixed(item.fix, boot_s, latitude_deg, longitude_deg)

    def told(
        self, boot_s: float, latitude_deg: float, longitude_deg: float, north: float, east: float
    ) -> None:
        """Take place and velocity as the estimator tells them."""
        place = complex(longitude_deg, latitude_deg)
        self._told.append((boot_s, place, complex(east, north)))
        self._compare()

    def fixed(self, fix: float, boot_s: float, latitude_deg: float, longitude_deg: float) -> None:
        """Take a place as the receiver tells it."""
        self._is_rtk = fix >= Fix.RTK_FLOAT
        self._fix = boot_s, complex(longitude_deg, latitude_deg)
        self._compare()

    def _compare(self) -> None:
        """Add a fix to the sums once positions around it have come."""
        at_s, fixed = self._fix
        if math.isnan(at_s):
            return
        for (before_s, place, move), (after_s, next_place, next_move) in pairwise(self._told):
            if before_s <= at_s < after_s <= before_s + GAP_MAX_S:
                part = (at_s - before_s) / (after_s - before_s)
                move += part * (next_move - move)
                off = METRES_PER_DEGREE * (place + part * (next_place - place) - fixed)
                off = complex(off.real * math.cos(math.radians(fixed.imag)), off.imag)
                more = 1.0, move, abs(move) ** 2, off, (move.conjugate() * off).real
                sums = self._sums[abs(move) > MOVING_M_S]
                sums[:] = (self._kept * a + b for a, b in zip(sums, more, strict=True))
                self._fix = math.nan, fixed
                return

    @property
    def offset(self) -> ReceiverOffset | None:
        """Return the least squares of offset = delay x velocity + constant; None: not known yet."""
        (standing, *_, still, _), (count, move, square, off, both) = self._sums
        if count.real >= FIXES_MIN:
            spread = square.real - abs(move) ** 2 / count.real
            if spread >= VARIANCE_MIN_M2_S2 * count.real:
                late_s = (both - move.conjugate() * off / count).real / spread
                off_m = abs((off - late_s * move) / count)
                return ReceiverOffset(late_s=late_s, off_m=off_m, is_rtk=self._is_rtk)
        if not standing.real >= FIXES_MIN:
            return None
        return ReceiverOffset(late_s=None, off_m=abs(still / standing), is_rtk=self._is_rtk)


def offset_of(
    told: Iterable[Sequence[float]], fixed: Iterable[Sequence[float]]
) -> ReceiverOffset | None:
    """Return what a receiver differed by, from rows of all that was heard.

    Each is when it came and what `told` or `fixed` take; NaN stands for what was not known.
    """
    watch = ReceiverWatch()
    rows: list[tuple[float, Callable[..., None], Sequence[float]]] = [
        (row[0], watch.told, row[1:]) for row in told
    ]
    rows += [(row[0], watch.fixed, row[1:]) for row in fixed]
    for _, take, values in sorted(rows, key=itemgetter(0)):
        if all(map(math.isfinite, values)):
            take(*values)
    return watch.offset

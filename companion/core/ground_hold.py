"""The dead-man of ground work: when strokes of a key, or lines of a script, are a held key.

Nothing says when a stroke was made, only when it was heard: a connection that stood still hands
over at once what was pressed in the meantime, though the key was let go long ago.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# A key that is held repeats 10 to 40 times a second; this is what may lie between two repeats.
HOLD_S = 0.5
# What a connection has held back comes in a burst. Strokes so close are one, and so many over so
# long are more than a burst is.
STROKE_GAP_S = 0.01
STROKES_MIN = 4
STROKES_OVER_S = 0.3
# Between clocks of two processes; what is further in the future is no time at all.
EARLY_S = -0.1
# Sums of times are right to far better than this, and no key repeats faster.
_BIT_S = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """The dead-man: a key that repeats. A few strokes, or many in a burst, are no hold.

    `strokes` are those since `first_s`, as they were heard: when they were made nobody knows.
    """

    first_s: float = -math.inf
    last_s: float = -math.inf
    strokes: int = 0

    def renewed(self, now_s: float) -> Hold:
        """Return the hold after one more stroke; after a gap it begins anew."""
        if not self.last_s + STROKE_GAP_S <= now_s < math.inf:
            return self
        if now_s < self.last_s + HOLD_S:
            return Hold(first_s=self.first_s, last_s=now_s, strokes=self.strokes + 1)
        return Hold(first_s=now_s, last_s=now_s, strokes=1)

    def is_held(self, now_s: float) -> bool:
        """Whether the key is down now."""
        young = now_s < self.last_s + HOLD_S and now_s - self.last_s >= EARLY_S
        long = self.last_s - self.first_s >= STROKES_OVER_S - _BIT_S
        return young and long and self.strokes >= STROKES_MIN

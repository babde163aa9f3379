"""What a catch was ordered by: a duty, or the width of a motor's pulse; and how it is said."""

from __future__ import annotations

from dataclasses import dataclass

# Between duties farther apart than this the curve is a guess.
GAP_MAX = 0.25
# The widest servo pulse: pulse widths are handled as shares of it, so that one fit serves both.
PULSE_FULL_US = 2500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """What a catch was ordered by, in words: `full` is what stands for 1."""

    name: str
    plural: str
    unit: str
    full: float
    gap_max: float

    def say(self, duty: float) -> str:
        """Return a value as it was typed.

        >>> PULSE.say(0.6), DUTY.say(0.6)
        ('1500 us', '0.6')
        """
        return f"{self.full * duty:.6g}{self.unit}"


DUTY = Scale(name="duty", plural="duties", unit="", full=1.0, gap_max=GAP_MAX)
# A motor's range is some 1000 us wide: the same share of it as of the duty.
PULSE = Scale(
    name="pulse", plural="pulses", unit=" us", full=PULSE_FULL_US, gap_max=250.0 / PULSE_FULL_US
)

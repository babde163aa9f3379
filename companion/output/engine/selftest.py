"""What the engine proves of itself before it says that it is ready; nothing is opened for it.

The levels of the safe state are written and read back, the ALIVE line is raised and lowered once
where that can be read, and some hundred wake-ups tell how late edges would be. What fails is a
fault that stays: the text says what, and what to do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

from companion.output.engine.lines import Lines
from companion.output.engine.wire import Wiring

# The second worst of so many is the 99th percentile.
WAKES = 100
WAKE_S = 0.001
# A computer that is still busy with the start of everything gets two more turns.
ROUNDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfTest:
    """What was found; None where the hardware, or the set-up, has no such thing.

    `fault` is empty if all is well. Lateness is that of the best round of wake-ups.
    """

    outputs: int = 0
    levels_read_back: bool | None = None
    alive_toggles: bool | None = None
    wakes: int = 0
    median_late_s: float = math.nan
    p99_late_s: float = math.nan
    worst_late_s: float = math.nan
    fault: str = ""

    def as_object(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)

    @classmethod
    def from_object(cls, found: dict[str, Any]) -> SelfTest:
        """Return the result of `as_object`; what it does not know is left out."""
        known = {field.name for field in fields(cls)}
        return cls(**{key: value for key, value in found.items() if key in known})

    def text(self) -> str:
        """Return one line for log and journal.

        >>> SelfTest(outputs=7, levels_read_back=True, wakes=100, median_late_s=1e-4,
        ...          p99_late_s=4e-4, worst_late_s=2e-3).text()
        '7 outputs, levels read back, wake-ups late by 0.1 ms (median), 0.4 ms (p99)'
        """
        if self.fault:
            return f"failed: {self.fault}"
        back = "levels read back" if self.levels_read_back else "levels cannot be read back"
        late = f"{self.median_late_s * 1e3:.1f} ms (median), {self.p99_late_s * 1e3:.1f} ms (p99)"
        alive = ", ALIVE toggles" if self.alive_toggles else ""
        return f"{self.outputs} outputs, {back}{alive}, wake-ups late by {late}"


def self_test(
    lines: Lines,
    wiring: Wiring,
    *,
    late_max_s: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> SelfTest:
    """Test lines that were opened; they are left at their safe levels."""
    late_s: list[float] = []
    alive = None
    try:
        can_read, fault = _safe_levels(lines, wiring)
        if can_read and not fault and wiring.alive is not None:
            alive, fault = _alive(lines, wiring, wiring.alive)
    except OSError as error:
        can_read, fault = None, f"outputs cannot be driven: {error.strerror or error}"
    if not fault:
        late_s, fault = _latency(late_max_s, clock, sleep)
    return SelfTest(
        outputs=len(wiring.lines),
        levels_read_back=can_read,
        alive_toggles=alive,
        wakes=len(late_s),
        median_late_s=late_s[len(late_s) // 2] if late_s else math.nan,
        p99_late_s=_p99_s(late_s),
        worst_late_s=late_s[-1] if late_s else math.nan,
        fault=fault,
    )


def wrong_lines(found: int, wanted: int, wiring: Wiring) -> str:
    """Return the numbers of the lines that have not the level they should.

    >>> wrong_lines(0b01, 0b11, Wiring(valves=(17, 18)))
    '18'
    """
    wrong = found ^ wanted
    return ", ".join(str(line) for n, line in enumerate(wiring.lines) if wrong >> n & 1)


def _safe_levels(lines: Lines, wiring: Wiring) -> tuple[bool | None, str]:
    """Write the safe levels; return whether they can be read back, and what is wrong."""
    lines.write(wiring.safe_levels)
    found = lines.read()
    if found is None:
        return None, ""
    if found == wiring.safe_levels:
        return True, ""
    stuck = wrong_lines(found, wiring.safe_levels, wiring)
    return False, f"outputs do not take their level: {stuck}; see driver and wiring"


def _alive(lines: Lines, wiring: Wiring, output: int) -> tuple[bool, str]:
    """Raise and lower ALIVE: a monostable holds its relay for its time once, all valves shut."""
    line, raised = wiring.lines[output], wiring.safe_levels ^ 1 << output
    lines.write(raised)
    rose = lines.read() == raised
    lines.write(wiring.safe_levels)
    if rose and lines.read() == wiring.safe_levels:
        return True, ""
    return False, f"ALIVE does not toggle on line {line}; see driver and wiring"


def _latency(
    late_max_s: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> tuple[list[float], str]:
    """Return how late the wake-ups of the best round were, in order, and what is wrong with it."""
    best: list[float] = []
    for _ in range(ROUNDS):
        late_s = sorted(_wake_late_s(clock, sleep) for _ in range(WAKES))
        if not best or _p99_s(late_s) < _p99_s(best):
            best = late_s
        if _p99_s(best) <= late_max_s:
            return best, ""
    text = f"wakes up {_p99_s(best) * 1e3:.1f} ms late; allow rtprio (docs/howto/wire-gpio.md)"
    return best, text


def _wake_late_s(clock: Callable[[], float], sleep: Callable[[float], None]) -> float:
    due_s = clock() + WAKE_S
    sleep(max(due_s - clock(), 0.0))
    return max(clock() - due_s, 0.0)


def _p99_s(ranked_s: list[float]) -> float:
    """Return what 99 in a hundred do not exceed."""
    return ranked_s[math.ceil(0.99 * len(ranked_s)) - 1] if ranked_s else math.nan

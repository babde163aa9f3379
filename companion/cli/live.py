"""What a flight looks like while it lasts: one block on a terminal, plain lines in a pipe.

Nothing here may delay a valve. The control loop hands over a line of JSON a few times a second by
a pipe that never blocks; another process draws it. A terminal that stands still (Ctrl-S, a pipe
that nobody reads) stops that process at most, and what does not fit is dropped.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np

from companion.cli.terminal import visible
from companion.core.frame import Floats
from companion.core.types import Decision
from companion.tally import SPEED_MIN_M_S, Tally, next_change_s, speed_of, wanted_l_ha

# So often something is drawn, and so often a plain line tells how it goes.
DRAWN_EVERY_S = 0.25
PLAIN_EVERY_S = 10.0
# With a change of a valve so near, the loop has better things to do.
QUIET_S = 0.01
# A pipe takes up to this as one piece, or nothing of it (PIPE_BUF of Linux).
_PIECE_MAX_BYTES = 4096
_LINES_KEPT = 200
_ENDING_S = 0.5
_FAULTS_MAX = 4
_TEXT_MAX = 200
# Each point costs a look at the map, 5 us on a laptop.
_AHEAD_M = np.arange(0.0, 31.0)
# A latched state whose fault is over: nothing is left to name, but to release.
_NO_FAULT = {"fault": "over, but latched: disable, then enable again"}
TRAINING = {"water": "TRAINING WITH WATER", "dry": "DRY RUN", "ground": "GROUND WORK"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """What an operator sees; None is not known. Rates in L/ha, flows in L/min, ages in s."""

    state: str = "boot"
    why: str = ""
    wanted_l_ha: float | None = None
    given_l_ha: float | None = None
    percent: float = 100.0
    flow_l_min: float | None = None
    volume_l: float | None = None
    metered_l: float | None = None
    tank_l: float | None = None
    next_s: float | None = None
    next_m: float | None = None
    speed_m_s: float | None = None
    vehicle: str = ""
    ages_s: Mapping[str, float | None] = field(default_factory=dict)
    faults: Sequence[str] = ()
    training: str = ""

    def rows(self) -> list[tuple[str, str]]:
        """Return what the block says, label and text.

        >>> dict(Shown(state="safe", why="not enabled").rows())["state"]
        'SAFE: not enabled'
        """
        percent = "" if self.percent == 100.0 else f" ({self.percent:.0f} % by the operator)"
        given = _number(self.given_l_ha, "L/ha", 1)
        metered = "" if self.metered_l is None else f", metered {self.metered_l:.2f} L"
        rows = [
            ("state", self.state.upper() + (f": {self.why}" if self.why else "")),
            ("rate", f"{_number(self.wanted_l_ha, 'L/ha', 1)} wanted, {given} given{percent}"),
            ("flow", _number(self.flow_l_min, "L/min", 2)),
            ("sprayed", _number(self.volume_l, "L", 2) + metered),
            ("tank", _number(self.tank_l, "L", 1)),
            ("boundary", self._next()),
            ("vehicle", ", ".join(filter(None, (self.vehicle, self._speed())))),
            ("ages", self._ages()),
            ("faults", "; ".join(self.faults) or _NO_FAULT.get(self.state, "none")),
        ]
        if self.training:
            rows.insert(0, ("training", TRAINING.get(self.training, self.training)))
        return rows

    def line(self) -> str:
        """Return the same as one line."""
        parts = [f"{self.state}: {self.why}" if self.why else self.state]
        if self.state in ("armed", "spraying"):
            parts.append(dict(self.rows())["rate"])
        parts += [f"{label} {text}" for label, text in self.rows() if label in ("sprayed", "tank")]
        parts += [f"fault: {text}" for text in self.faults]
        return ", ".join(parts)

    def _next(self) -> str:
        if self.next_m is not None:
            after = "" if self.next_s is None else f", {self.next_s:.0f} s"
            return f"in {self.next_m:.0f} m{after}"
        return "none in sight" if self.next_s is None else f"in {self.next_s:.1f} s"

    def _speed(self) -> str:
        return "" if self.speed_m_s is None else f"{self.speed_m_s:.1f} m/s"

    def _ages(self) -> str:
        return ", ".join(f"{name} {_number(age, 's', 1)}" for name, age in self.ages_s.items())


def _number(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f} {unit}"


class Watcher:
    """Makes of decisions what is shown."""

    def __init__(
        self,
        *,
        width_m: float,
        training: str = "",
        faults: Callable[[], Sequence[str | None]],
        rates_at: Callable[[Floats, Floats], Floats] | None = None,
    ) -> None:
        self._tally = Tally(width_m)
        self._rates_at = rates_at
        self._training = "" if training == "no" else training
        self._faults = faults
        self._metered_from_ml: float | None = None

    def take(self, decision: Decision) -> None:
        """Add a decision; called at every step."""
        self._tally.take(decision)

    def shown(self, decision: Decision) -> Shown:
        """Return what is shown of a decision."""
        state, now_s = decision.state, decision.now_s
        speed_m_s = speed_of(decision)
        next_m = self._boundary_m(decision, speed_m_s)
        found = [text for text in self._faults() if text]
        found += [finding.text for finding in decision.findings]
        shown: dict[str, Any] = {
            "state": decision.sprayer.value,
            "why": ", ".join(one.words for one in sorted(decision.inhibits)),
            "wanted_l_ha": wanted_l_ha(decision),
            "given_l_ha": self._tally.given_l_ha(decision),
            "flow_l_min": decision.flow_l_min,
            "volume_l": self._tally.volume_l,
            "next_s": None if next_m is None or speed_m_s is None else next_m / speed_m_s,
            "next_m": next_m,
            "speed_m_s": speed_m_s,
            "faults": [text[:_TEXT_MAX] for text in dict.fromkeys(found)][:_FAULTS_MAX],
            "training": self._training,
        }
        if state is not None:
            heard_s = {
                "position": state.position_received_s,
                "heartbeat": state.heartbeat_received_s,
                "flow meter": None if state.flow is None else state.flow.received_s,
            }
            if state.flow is None:
                del heard_s["flow meter"]
            shown |= {
                "percent": state.rate_percent,
                "metered_l": self._metered_l(decision),
                "tank_l": None if state.tank is None else state.tank.level_l,
                "vehicle": f"{state.mode or 'mode unknown'}, "
                f"{'armed' if state.armed else 'disarmed'}, {state.height_m:.1f} m",
                "ages_s": {
                    name: None if at_s is None else max(now_s - at_s, 0.0)
                    for name, at_s in heard_s.items()
                },
            }
        return Shown(**shown)

    def _boundary_m(self, decision: Decision, speed_m_s: float | None) -> float | None:
        """Return how far it is straight ahead to another rate, to the metre; None: none near."""
        state = decision.state
        if self._rates_at is None or state is None or speed_m_s is None:
            return None
        if not speed_m_s >= SPEED_MIN_M_S:
            return None
        east = state.east_m + state.velocity_east_m_s / speed_m_s * _AHEAD_M
        north = state.north_m + state.velocity_north_m_s / speed_m_s * _AHEAD_M
        rates = np.nan_to_num(self._rates_at(east, north), nan=-1.0)
        others = np.flatnonzero(rates != rates[0])
        return float(_AHEAD_M[others[0]]) if len(others) else None

    def _metered_l(self, decision: Decision) -> float | None:
        flow = None if decision.state is None else decision.state.flow
        if flow is None or not math.isfinite(flow.volume_ml):
            return None
        if self._metered_from_ml is None:
            self._metered_from_ml = flow.volume_ml
        return (flow.volume_ml - self._metered_from_ml) / 1000.0


# The side of the control loop: what it hands over, and never waits for.


class Screen:
    """Shows a run on stderr: a block on a terminal, else lines; `with` opens and closes it.

    It is the handler of the program's log too: its lines must not stop the loop either.
    """

    def __init__(
        self, watcher: Watcher | None = None, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.watcher = watcher
        self._clock = clock
        self._due_s = -math.inf
        self._sink: _Child | _Lines = _Child() if _is_terminal() else _Lines()

    def __enter__(self) -> Self:
        """Begin to show."""
        self._sink.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Show what is left, and wait half a second for that at most."""
        self._sink.close()

    def take(self, decision: Decision) -> None:
        """Take a decision that was carried out; draw now and then."""
        if self.watcher is None:
            return
        self.watcher.take(decision)
        now_s = self._clock()
        ahead_s = next_change_s(decision)
        if now_s < self._due_s or (ahead_s is not None and ahead_s < QUIET_S):
            return
        self._due_s = now_s + DRAWN_EVERY_S
        self._sink.show(self.watcher.shown(decision), now_s)

    def take_log(self, level: int) -> None:
        """Take the program's log, unless somebody else has it."""
        if not logging.root.handlers:
            logging.basicConfig(handlers=[_Handler(self._sink)], level=level)


class _Handler(logging.Handler):
    def __init__(self, sink: _Child | _Lines) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
        self._sink = sink

    def emit(self, record: logging.LogRecord) -> None:
        self._sink.say(self.format(record))


def _is_terminal() -> bool:
    return sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb"


class _Child:
    """Another process that draws; it gets JSON, a line each."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._waiting: deque[bytes] = deque(maxlen=_LINES_KEPT)

    def open(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "companion.cli.drawing"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=False,
        )
        if self._process.stdin is not None:
            os.set_blocking(self._process.stdin.fileno(), False)

    def show(self, shown: Shown, _now_s: float) -> None:
        self._send()
        self._send(_piece(asdict(shown)))

    def say(self, text: str) -> None:
        if self._process is None:
            _print(text)
            return
        self._waiting.append(_piece({"line": text[:1000]}))
        self._send()

    def close(self) -> None:
        process, self._process = self._process, None
        if process is None or process.stdin is None:
            return
        # A stream that cannot be flushed now would wait for its reader.
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _send(self, piece: bytes | None = None) -> None:
        """Write what fits: lines that wait first, then the newest state, or nothing of it."""
        if self._process is None or self._process.stdin is None:
            return
        descriptor = self._process.stdin.fileno()
        try:
            while self._waiting:
                os.write(descriptor, self._waiting[0])
                self._waiting.popleft()
            if piece is not None:
                os.write(descriptor, piece)
        except OSError:
            return  # full: the terminal stands still; or gone: there is nobody to draw


def _piece(content: Mapping[str, Any]) -> bytes:
    """Return a line that a pipe takes as a whole or not at all."""
    line = json.dumps(content).encode() + b"\n"
    return line if len(line) <= _PIECE_MAX_BYTES else b"{}\n"


class _Lines:
    """A thread that writes lines to stderr, wherever that leads."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        self._news = threading.Event()
        self._thread: threading.Thread | None = None
        self._ends = False
        self._said: tuple[str, str, Sequence[str]] | None = None
        self._said_s = -math.inf

    def open(self) -> None:
        # A daemon: a pipe that nobody reads must not keep the program from its end either.
        self._thread = threading.Thread(target=self._write, daemon=True, name="stderr")
        self._thread.start()

    def show(self, shown: Shown, now_s: float) -> None:
        told = (shown.state, shown.why, tuple(shown.faults))
        is_news = told != self._said and now_s - self._said_s >= 1.0
        if not is_news and (shown.state != "spraying" or now_s - self._said_s < PLAIN_EVERY_S):
            return
        self._said, self._said_s = told, now_s
        self.say(shown.line())

    def say(self, text: str) -> None:
        if self._thread is None:
            _print(text)
            return
        self._lines.append(text)
        self._news.set()

    def close(self) -> None:
        thread, self._thread = self._thread, None
        self._ends = True
        self._news.set()
        if thread is not None:
            thread.join(_ENDING_S)

    def _write(self) -> None:
        while True:
            self._news.wait()
            self._news.clear()
            while self._lines:
                # Not by sys.stderr: whoever waits in it holds its lock, and the program's end too.
                _print(self._lines.popleft())
            if self._ends:
                return


def _print(text: str) -> None:
    """Write a line before the loop begins or after it has ended: it may wait."""
    with contextlib.suppress(OSError):
        os.write(2, (visible(text) + "\n").encode(errors="replace"))

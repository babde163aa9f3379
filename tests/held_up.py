"""What a flight in real time that fails is told: how long this computer held it up.

A failure stays one. But a computer that gives a process no processor for a tenth of a second moves
a change by half a metre, and whether it did cannot be asked afterwards. The kernel is asked, not
the companion: how long we and our children waited for a processor, and how long the host of this
computer kept one for others. Flights that pass see 0.2 s, too: it is a hint and no excuse.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

# Looked at so often; children are looked for five times less often.
LOOK_S, CHILDREN_S = 0.1, 0.5
TICKS = os.sysconf("SC_CLK_TCK")


class Watch:
    """The longest time for which this computer held up one of our processes, as it grows."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._begun_s, self._stolen_s = time.monotonic(), _stolen_s()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="held-up", daemon=True)

    def begin(self) -> None:
        self._thread.start()

    def end(self) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        waited_s: dict[int, float] = {}
        watched: list[int] = []
        look_s, stolen_s = self._begun_s, self._stolen_s
        children_s = look_s
        is_over = False
        while not is_over:
            is_over = self._over.wait(LOOK_S)
            now_s = time.monotonic()
            self._see(now_s - look_s - LOOK_S)
            look_s = now_s
            before_s, stolen_s = stolen_s, _stolen_s()
            for held_s in map(float.__sub__, stolen_s, before_s):
                self._see(held_s)
            if now_s >= children_s:
                watched, children_s = list(_descendants()), now_s + CHILDREN_S
            for pid in watched:
                now_waited_s = _waited_s(pid)
                self._see(now_waited_s - waited_s.get(pid, now_waited_s))
                waited_s[pid] = now_waited_s

    def _see(self, held_s: float) -> None:
        self.longest_s = max(self.longest_s, held_s)


def _waited_s(pid: int) -> float:
    """Return how long a process's first thread has been ready to run and did not."""
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    return 0.0


def _stolen_s() -> list[float]:
    """Return how long the host of this computer has kept each of its processors for others."""
    with suppress(OSError):
        lines = Path("/proc/stat").read_text().splitlines()
        return [int(line.split()[8]) / TICKS for line in lines if line[:3] == "cpu"][1:]
    return []


def _descendants(pid: int | str = "self") -> Iterator[int]:
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, children.read_text().split()):
                yield child
                yield from _descendants(child)


@contextmanager
def watched() -> Iterator[Watch]:
    """Watch for as long as the block takes."""
    watch = Watch()
    watch.begin()
    try:
        yield watch
    finally:
        watch.end()


def fly(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Run a test once; where it fails, its report says how long it was held up at most."""
    hook = item.ihook
    hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with watched() as watch:
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        if report.failed:
            told = f"{watch.longest_s:.2f} s at most of {LOOK_S:g} s, or at a stretch"
            report.sections.append(("Held up by this computer", told))
        hook.pytest_runtest_logreport(report=report)
    hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)

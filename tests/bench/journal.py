"""The journal's figures: `python -m tests.bench.journal [kills|torn|hour|rate|held] [--count N]`.

`kills`: a real process that writes is killed (SIGKILL) at random moments; every row that it had
reported as committed must be there. `torn`: the log that a crash leaves is cut off or garbled at
random; every transaction before the damage must be there. `hour`: an hour at fifty decisions a
second, a commit a simulated second: size, and what the writer takes. `rate`: the same at its real
pace, with and without the journal: what a turn of the control loop takes. `held`: a quarter of an
hour on a full disk, all valves open: what it takes of the memory, and of time once there is room.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import select
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import pyogrio

from analysis.flown.read_applied import read_applied
from analysis.journals.content import read_journal
from analysis.journals.salvage import recover
from companion.core.options.coverage import Coverage
from companion.core.setup import Setup
from companion.journal.codec import encode
from companion.journal.journal import Journal, open_for_flight
from companion.journal.writer import LinkSample, Writer
from companion.runtime import SWITCH_S
from tests.bench.journal_flight import START_S, Flight, Turn, example_setup, open_setup

KILL_COMMIT_S = 0.02
WAL_HEADER, FRAME_HEADER = 32, 24


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value that a share of all does not exceed."""
    ranked = sorted(values)
    return ranked[min(len(ranked) - 1, int(share * len(ranked)))]


def checked(path: Path, expected: Sequence[str], least: int) -> tuple[float, int]:
    """Recover a journal that was cut and check it; return how long that took, and its rows."""
    found = recover(path)
    assert found is None or found.outcome == "recovered", found
    content = read_journal(path)
    bodies = [entry.body for entry in content.entries]
    rows = len(bodies) + len(content.events)
    assert rows >= least, f"{rows} rows of {least}"
    assert bodies == list(expected[: len(bodies)])
    assert content.meta["closed"] in ("recovered", "yes")
    assert "applied" in {name for name, _ in pyogrio.list_layers(path)}
    assert not path.with_name(path.name + "-wal").exists()
    return (0.0 if found is None else found.took_s), len(bodies)


# ------------------------------------------------------------------------------------------ kills


def kills(
    how_many: int, *, seed: int = 1, seconds: float = 20.0, say: Callable[[str], None] = _say
) -> dict[str, Any]:
    """Kill a process that writes, so many times."""
    chance, setup = random.Random(seed), example_setup()
    turns = list(Flight(setup, seed=seed).turns(seconds))
    expected = [encode(item) for turn in turns for item in (*turn.inputs, turn.decision)]
    worst_s, rows = 0.0, []
    for number in range(how_many):
        with tempfile.TemporaryDirectory() as folder:
            committed = _killed(Path(folder), setup, turns, chance.uniform(0.0, 0.4))
            (path,) = Path(folder).glob("flight-*.gpkg")
            took_s, found = checked(path, expected, committed)
            worst_s = max(worst_s, took_s)
            rows.append(found - committed)  # and the events, of which there is one
        if number % 20 == 19:
            say(f"{number + 1} kills: every committed row is there")
    return {"kills": how_many, "recovery_worst_s": worst_s, "rows_beyond_report": max(rows)}


def _killed(folder: Path, setup: Setup, turns: Sequence[Turn], after_s: float) -> int:
    """Let a child write, kill it, and return how many rows it had reported as committed."""
    receive, send = os.pipe()
    pid = os.fork()
    if pid == 0:
        _write_for_ever(folder, setup, turns, send)
    os.close(send)
    reported = b""
    kill_at_s: float | None = None
    while kill_at_s is None or time.monotonic() < kill_at_s:
        wait_s = 30.0 if kill_at_s is None else max(kill_at_s - time.monotonic(), 0.0)
        if select.select([receive], [], [], wait_s)[0]:
            reported += os.read(receive, 65536)
            if kill_at_s is None:
                kill_at_s = time.monotonic() + after_s
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while chunk := os.read(receive, 65536):
        reported += chunk
    os.close(receive)
    whole = reported[: reported.rfind(b"\n")].split(b"\n")
    return int(whole[-1] or 0)


def _write_for_ever(folder: Path, setup: Setup, turns: Sequence[Turn], send: int) -> None:
    journal = Journal.create(folder, setup=setup, started_s=START_S, commit_every_s=KILL_COMMIT_S)
    told = 0
    for turn in turns:
        record(journal, turn)
        time.sleep(0.001)
        if journal.committed != told:
            told = journal.committed
            os.write(send, b"%d\n" % told)
    signal.pause()


def record(journal: Journal, turn: Turn) -> None:
    """Give the journal one turn."""
    for item in turn.inputs:
        journal.record_input(item)
    for order in turn.orders:
        journal.record_order(order.valve, order.duty, order.planned_s, order.given_s)
    journal.record_decision(turn.decision)


# ------------------------------------------------------------------------------------------- torn


class Second:
    """Drives a writer as the journal's thread does, a commit a second, but as fast as it goes."""

    def __init__(self, path: Path, setup: Setup) -> None:
        self.connection = open_for_flight(path)
        self.connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
        self._sequence = count(1)
        self.writer = Writer(
            self.connection,
            frame=setup.frame,
            utc_offset_s=0.0,
            next_sequence=self._sequence.__next__,
        )
        self.writer.valves.from_orders = True
        self.commit_s: list[float] = []
        self.write_s: list[float] = []

    def write(
        self,
        turns: Sequence[Turn],
        *,
        link: LinkSample | None = None,
        coverage: Coverage | None = None,
    ) -> None:
        """Write the turns of one second and commit them."""
        began_s = time.perf_counter()
        if link is not None:
            self.writer.write(0, link)
        for turn in turns:
            for item in (*turn.inputs, turn.decision):
                self.writer.write(next(self._sequence), item)
            for order in turn.orders:
                self.writer.write(0, order)
        middle_s = time.perf_counter()
        self.writer.commit(lost_before=0, coverage=coverage)
        self.commit_s.append(time.perf_counter() - middle_s)
        self.write_s.append(middle_s - began_s)


def torn(
    how_many: int, *, seed: int = 1, seconds: int = 30, say: Callable[[str], None] = _say
) -> dict[str, Any]:
    """Damage the log of a crash, so many times."""
    chance, setup = random.Random(seed), example_setup()
    with tempfile.TemporaryDirectory() as folder:
        left, ends, expected = crashed(Path(folder), setup, seconds=seconds, seed=seed)
        log = left / "flight-0001.gpkg-wal"
        size, worst_s, kept = log.stat().st_size, 0.0, []
        for number in range(how_many):
            copy = Path(folder) / "copy"
            shutil.copytree(left, copy)
            at = chance.randrange(size)
            with (copy / log.name).open("r+b") as file:
                if number % 2:
                    file.truncate(at)
                else:
                    file.seek(at)
                    file.write(chance.randbytes(min(4096, size - at)))
            intact = sum(end <= at for end, _ in ends)
            least = max((rows for end, rows in ends if end <= at), default=0)
            took_s, found = checked(copy / "flight-0001.gpkg", expected, least)
            assert found == least, f"{found} rows where {intact} transactions of {least} are whole"
            worst_s = max(worst_s, took_s)
            kept.append(intact)
            shutil.rmtree(copy)
            if number % 50 == 49:
                say(f"{number + 1} torn logs: every whole transaction is there")
    return {
        "torn": how_many,
        "transactions": len(ends),
        "kept_mean": sum(kept) / len(kept),
        "recovery_worst_s": worst_s,
    }


def crashed(
    folder: Path, setup: Setup, *, seconds: int, seed: int
) -> tuple[Path, list[tuple[int, int]], list[str]]:
    """Return a journal that was cut with its log, and where in it each transaction ends.

    Each of these is (bytes of the log, rows that are in the file by then); and all rows.
    """
    with Journal.create(folder / "live", setup=setup, started_s=START_S) as journal:
        pass
    drive = Second(journal.path, setup)
    log = journal.path.with_name(journal.path.name + "-wal")
    ends, expected = [], []
    flight = Flight(setup, seed=seed)
    for second in range(seconds):
        turns = [flight.turn(50 * second + number) for number in range(50)]
        drive.write(turns)
        expected += [encode(item) for turn in turns for item in (*turn.inputs, turn.decision)]
        ends.append((log.stat().st_size, len(expected)))
    left = folder / "left"
    shutil.copytree(journal.path.parent, left)
    drive.connection.close()
    return left, ends, expected


# -------------------------------------------------------------------------------------- hour, rate


def hour(minutes: float, *, seed: int = 1, say: Callable[[str], None] = _say) -> dict[str, Any]:
    """Write a long flight a second at a time, all valves open; measure size, writer, recovery."""
    setup = open_setup()
    with tempfile.TemporaryDirectory() as folder:
        with Journal.create(Path(folder) / "live", setup=setup, started_s=START_S) as journal:
            pass
        path = journal.path
        empty = path.stat().st_size
        drive, flight = Second(path, setup), Flight(setup, seed=seed)
        rows = open_count = 0
        for second in range(round(60 * minutes)):
            turns = [flight.turn(50 * second + number) for number in range(50)]
            rows += sum(len(turn.inputs) + 1 for turn in turns)
            open_count += sum(turn.decision.plan.opens for turn in turns)
            flight.treat(second)
            drive.write(turns, link=flight.link(second), coverage=flight.coverage)
            if second % 300 == 299:
                say(f"{(second + 1) // 60} min written")
        shutil.copytree(path.parent, Path(folder) / "left")
        drive.writer.finish(lost_before=0)
        hours = minutes / 60.0
        result = {
            "minutes": minutes,
            "rows": rows,
            "open_share": open_count / (3000.0 * minutes),
            "mb_h": (path.stat().st_size - empty) / 1e6 / hours,
            "mb_h_by_table": _tables(path, hours),
            "write_mean_ms_s": 1e3 * sum(drive.write_s) / len(drive.write_s),
            "commit_median_ms": 1e3 * quantile(drive.commit_s, 0.5),
            "commit_p99_ms": 1e3 * quantile(drive.commit_s, 0.99),
            "commit_max_ms": 1e3 * max(drive.commit_s),
            "commits": len(drive.commit_s),
        }
        found = recover(Path(folder) / "left" / path.name)
        assert found is not None
        assert found.outcome == "recovered", found
        began_s = time.process_time()
        read_applied(path)
        middle_s = time.process_time()
        content = read_journal(path)
        result |= {
            "load": os.getloadavg()[0],
            "recovery_s": found.took_s,
            "read_applied_cpu_s": middle_s - began_s,
            "read_all_cpu_s": time.process_time() - middle_s,
            "read_rows": len(content.entries),
        }
        assert len(content.entries) == rows
        assert content.lost == 0
        return result


def held(minutes: float, *, seed: int = 1) -> dict[str, Any]:
    """Write to a disk that is full, then make room."""
    setup = open_setup()
    with tempfile.TemporaryDirectory() as folder:
        with Journal.create(Path(folder) / "live", setup=setup, started_s=START_S) as journal:
            pass
        drive, flight = Second(journal.path, setup), Flight(setup, seed=seed)
        drive.connection.execute("PRAGMA max_page_count = 1").fetchall()
        before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for second in range(round(60 * minutes)):
            drive.write([flight.turn(50 * second + number) for number in range(50)])
        waiting, memory = drive.writer.waiting, drive.writer._waiting_bytes
        after_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        drive.connection.execute("PRAGMA max_page_count = 1000000000").fetchall()
        busy_s = time.process_time()
        drive.writer.commit(lost_before=0)
        busy_s = time.process_time() - busy_s
        drive.writer.finish(lost_before=0)
        assert read_journal(journal.path).lost == drive.writer.lost == 0
        return {
            "minutes": minutes,
            "rows": waiting,
            "counted_mb": memory / 1e6,
            "process_grew_mb": (after_kb - before_kb) / 1e3,
            "written_cpu_s": busy_s,
        }


def _tables(path: Path, hours: float) -> dict[str, float]:
    connection = sqlite3.connect(path)
    try:
        rows = connection.execute(
            "SELECT name, sum(pgsize) FROM dbstat GROUP BY name ORDER BY 2 DESC LIMIT 7"
        ).fetchall()
    except sqlite3.OperationalError:  # a SQLite without its statistics
        return {}
    finally:
        connection.close()
    return {name: size / 1e6 / hours for name, size in rows}


def rate(seconds: float, *, seed: int = 1) -> dict[str, Any]:
    """Fly at the real pace, without a journal, with it, and again; what a turn takes."""
    setup = example_setup()
    result: dict[str, Any] = {"seconds": seconds}
    for name in ("without", "with", "without again", "with again"):
        with tempfile.TemporaryDirectory() as folder:
            result[name] = _paced(Path(folder) if "out" not in name else None, setup, seconds, seed)
    return result


def _paced(folder: Path | None, setup: Setup, seconds: float, seed: int) -> dict[str, Any]:
    flight, turn_s, commit_s, cpu_s = Flight(setup, seed=seed), [], [], []
    sys.setswitchinterval(SWITCH_S)  # as `vrspray run` does
    journal = None
    if folder is not None:
        journal = Journal.create(folder, setup=setup, started_s=START_S)
        journal.expect_orders()
        commit = journal._writer.commit

        def timed(**named: Any) -> None:
            began_s, busy_s = time.perf_counter(), time.thread_time()
            commit(**named)
            commit_s.append(time.perf_counter() - began_s)
            cpu_s.append(time.thread_time() - busy_s)

        journal._writer.commit = timed  # type: ignore[method-assign]
    began_s = time.perf_counter()
    for number in range(round(50 * seconds)):
        time.sleep(max(began_s + number / 50 - time.perf_counter(), 0.0))
        at_s = time.perf_counter()
        turn = flight.turn(number)
        if journal is not None:
            record(journal, turn)
        turn_s.append(time.perf_counter() - at_s)
    result: dict[str, Any] = {
        "load": os.getloadavg()[0],
        "turn_median_ms": 1e3 * quantile(turn_s, 0.5),
        "turn_p99_ms": 1e3 * quantile(turn_s, 0.99),
        "turn_max_ms": 1e3 * max(turn_s),
    }
    if journal is not None:
        journal.close()
        result |= {
            "lost": journal.lost,
            "commits": len(commit_s),
            "commit_p99_ms": 1e3 * quantile(commit_s, 0.99),
            "commit_max_ms": 1e3 * max(commit_s),
            "commit_cpu_p99_ms": 1e3 * quantile(cpu_s, 0.99),
        }
    return result


def main() -> None:
    """Run what is asked for and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", default=["kills", "torn", "hour", "rate"])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "kills": lambda: kills(asked.count, seed=asked.seed),
        "torn": lambda: torn(asked.count, seed=asked.seed),
        "hour": lambda: hour(asked.minutes, seed=asked.seed),
        "rate": lambda: rate(asked.seconds, seed=asked.seed),
        "held": lambda: held(min(asked.minutes, 15.0), seed=asked.seed),
    }
    found = {name: parts[name]() for name in asked.what}
    sys.stdout.write(f"{json.dumps(found, indent=1)}\n")


if __name__ == "__main__":
    main()

"""Proof that the tests catch what they must: each mutation of the code makes a test fail.

`python -m tests.mutations [--check] [part of a name ...]`, or `make mutants`. The mutations are in
`mutants.toml`; those of the interlock and of every `finally` are made from the code itself. All
happens in copies of the repository; docs/contributing/testing.md says how to read the result.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIST = Path(__file__).with_name("mutants.toml")
INTERLOCK = "companion/core/safety.py"
PACKAGES = ("companion", "sitl", "analysis", "missions")
LEFT_OUT = (".venv*", ".git", ".*_cache", ".hypothesis", "*.egg-info", "demo-out", "flights")
# Of the processor's time, so that a busy computer proves nothing by itself; on the clock there is
# time enough for a slow one.
TEST_S = 90
CLOCK_S = 900.0
ALL_S = 3600.0
TESTS = (
    "import resource, sys, pytest; s = int(sys.argv[1]); "
    "resource.setrlimit(resource.RLIMIT_CPU, (s, s + 5)); sys.exit(pytest.main(sys.argv[2:]))"
)
WORKERS = 2
BAD = ("SURVIVED", "STALE", "BROKEN")


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change of one file and the tests of which at least one must fail then."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str | None:
        """Return the mutated text; None where `old` is not there exactly once, or says the same."""
        if text.count(self.old) != 1 or self.old == self.new:
            return None
        return text.replace(self.old, self.new)


def listed(root: Path, path: Path = LIST) -> Iterator[Mutant]:
    """Yield every mutant: those that are written down and those that the code itself names."""
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    tests: dict[str, list[str]] = data["tests"]
    for entry in data["mutant"]:
        chosen = entry.get("tests") or tests[entry["file"]]
        yield Mutant(**{**entry, "tests": tuple(chosen)})
    yield from _inhibits(root, tests)
    for package in PACKAGES:
        for source in sorted((root / package).rglob("*.py")):
            file = source.relative_to(root).as_posix()
            text = source.read_text(encoding="utf-8")
            for name, old, new in without_finally(text):
                yield Mutant(
                    name=f"{name} {file}", file=file, old=old, new=new, tests=tuple(tests[file])
                )


def _inhibits(root: Path, tests: dict[str, list[str]]) -> Iterator[Mutant]:
    text = (root / INTERLOCK).read_text(encoding="utf-8")
    for match in re.finditer(r"found\.append\(Inhibit\.(\w+)\)", text):
        yield Mutant(
            name=f"no check of {match[1]}",
            file=INTERLOCK,
            old=match[0],
            new="pass",
            tests=tuple(tests[INTERLOCK]),
        )


def without_finally(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield (name, old, new) for every `finally`: left out, and reached only if all went well."""
    if "finally:" not in text:
        return
    lines = text.splitlines(keepends=True)
    tries = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Try)]
    for node in tries:
        if not node.finalbody:
            continue
        indent = " " * node.col_offset
        end = node.finalbody[-1].end_lineno or 0
        keyword = next(
            i for i in range(node.finalbody[0].lineno - 2, 0, -1)
            if lines[i].startswith(f"{indent}finally:")
        )  # fmt: skip
        body = "".join(lines[node.lineno - 1 : keyword])
        last = "".join(line.removeprefix("    ") for line in lines[keyword + 1 : end])
        if not node.handlers:
            body = f"{indent}if True:\n" + "".join(lines[node.lineno : keyword])
        old = "".join(lines[node.lineno - 1 : end])
        number = sum(other.lineno <= node.lineno for other in tries if other.finalbody)
        yield f"no `finally` {number} in", old, body
        yield f"`finally` {number} only if all went well in", old, body + last


class Copy:
    """A copy of the repository in which tests run; nothing of the original is imported there."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "copy"
        shutil.copytree(ROOT, self.root, ignore=shutil.ignore_patterns(*LEFT_OUT))
        self._env = {**os.environ, "PYTHONPATH": str(self.root), "PYTHONHASHSEED": "0"}
        self._changes = 0
        self._process: subprocess.Popen[str] | None = None
        probe = "; ".join(f"import {name}; print({name}.__file__)" for name in PACKAGES)
        found = self._python("-c", probe).stdout.split()
        if not all(Path(path).is_relative_to(self.root) for path in found) or len(found) < 4:
            raise SystemExit(f"mutations: the tests would not import the copy but {found}")

    def _python(self, *arguments: str, within_s: float = 600.0) -> subprocess.CompletedProcess[str]:
        self._process = process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=self.root, env=self._env, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            out, _ = process.communicate(timeout=within_s)
        finally:
            self.end()
            process.wait()
        return subprocess.CompletedProcess(arguments, process.returncode, out)

    def end(self) -> None:
        """End what runs, with its whole session: a failed test may leave processes behind."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def test(self, tests: Sequence[str], cpu_s: int, within_s: float) -> tuple[int, str]:
        """Return pytest's exit code and the first failed test; -SIGXCPU beyond `cpu_s`."""
        options = ("-x", "-q", "--tb=no", "-p", "no:cacheprovider")
        done = self._python("-c", TESTS, str(cpu_s), *options, *tests, within_s=within_s)
        failed = re.search(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
        return done.returncode, failed[1] if failed else " ".join(done.stdout.split())[-200:]

    def verdict(self, mutant: Mutant) -> tuple[str, str]:
        """Return what became of a mutant, and by which test."""
        path = self.root / mutant.file
        text = path.read_text(encoding="utf-8")
        mutated = mutant.applied(text)
        if mutated is None:
            return "STALE", "its old text is not there exactly once"
        times = path.stat()
        try:
            path.write_text(mutated, encoding="utf-8")
            # Compiled code is known by its source's time and size: give each mutant its own.
            self._changes += 1
            os.utime(path, (times.st_atime, times.st_mtime + self._changes))
            code, found = self.test(mutant.tests, TEST_S, CLOCK_S)
        except subprocess.TimeoutExpired:
            return "killed", f"not done after {CLOCK_S:.0f} s"
        finally:
            path.write_text(text, encoding="utf-8")
            os.utime(path, (times.st_atime, times.st_mtime))
        if code == -signal.SIGXCPU:
            return "killed", f"not done after {TEST_S} s of processor time"
        if code == 0:
            return "SURVIVED", " ".join(mutant.tests)
        # A signal that nobody took ends pytest itself.
        ended = code in (-signal.SIGTERM, -signal.SIGINT) or "KeyboardInterrupt" in found
        return ("killed", found) if code == 1 or ended else ("BROKEN", found)


def say(*lines: str) -> None:
    """Write lines of the result, at once."""
    sys.stdout.write("\n".join(lines) + "\n")
    sys.stdout.flush()


def run(mutants: Sequence[Mutant]) -> int:
    """Try every mutant, each worker in a copy of its own; return how many were not killed."""
    waiting: queue.SimpleQueue[Mutant] = queue.SimpleQueue()
    bad: list[str] = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies = [Copy(Path(folder) / str(i)) for i in range(WORKERS)]
        # On the code as it is every test must pass, or a failure would prove nothing.
        every = sorted({test for each in mutants for test in each.tests})
        code, found = copies[0].test(every, int(ALL_S), ALL_S)
        if code:
            say(f"mutations: without any mutation, exit {code}: {found}")
            return 1
        for mutant in mutants:
            waiting.put(mutant)
        threads = [threading.Thread(target=_work, args=(copy, waiting, bad)) for copy in copies]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        except KeyboardInterrupt:  # nothing goes on in a folder that is going away
            while not waiting.empty():
                waiting.get()
            for copy, thread in zip(copies, threads, strict=True):
                copy.end()
                thread.join()
            raise
    say(f"\n{len(mutants) - len(bad)} of {len(mutants)} mutants killed", *bad)
    return len(bad)


def _work(copy: Copy, waiting: queue.SimpleQueue[Mutant], bad: list[str]) -> None:
    """Try one mutant after the other until none is left."""
    while True:
        try:
            mutant = waiting.get_nowait()
        except queue.Empty:
            return
        began_s = time.monotonic()
        word, by = copy.verdict(mutant)
        say(f"{word:8}  {time.monotonic() - began_s:4.1f} s  {mutant.name}: {by}")
        if word in BAD:
            bad.append(f"{word:8}  {mutant.file}: {mutant.name}")


def main() -> int:
    """Run the mutants whose names hold one of the given words; all without any."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations")
    parser.add_argument("names", nargs="*", metavar="WORD", help="only mutants named like this")
    parser.add_argument("--check", action="store_true", help="only whether all still apply")
    given = parser.parse_args()
    mutants = [
        mutant
        for mutant in listed(ROOT)
        if not given.names or any(name in f"{mutant.name} {mutant.file}" for name in given.names)
    ]
    if not given.check:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        return min(run(mutants), 1)
    stale = [
        mutant.name
        for mutant in mutants
        if mutant.applied((ROOT / mutant.file).read_text(encoding="utf-8")) is None
    ]
    say(f"{len(mutants)} mutants, {len(stale)} do not apply", *stale)
    return min(len(stale), 1)


if __name__ == "__main__":
    sys.exit(main())

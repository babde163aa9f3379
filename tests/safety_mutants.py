"""Mutation testing of what opens valves: interlock, state, lease, pulses, the engine's turns.

`python -m tests.safety_mutants [part of a mutant's name ...]`, or `make mutants-safety`. `mutmut`
changes one thing at a time in a copy of the repository and runs the tests of these files, quick
ones first. It prints what survived.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.mutations import LEFT_OUT, PACKAGES, ROOT

TOOL = ROOT / ".venv" / "mutmut"
SOURCES = (
    "companion/core/safety.py",
    "companion/output/engine/engine.py",
    "companion/output/pwm.py",
    "companion/output/return_valve.py",
    "companion/output/timed.py",
)
TESTS = (
    "tests/companion/test_interlock.py",
    "tests/companion/test_caught_core.py",
    "tests/companion/test_sprayer_state.py",
    "tests/companion/test_engine_turns.py",
    "tests/companion/test_pwm.py",
    "tests/companion/test_timed.py",
    "tests/companion/test_schedule_clauses.py",
    "tests/companion/test_pwm_laws.py",
    "tests/companion/test_engine_laws.py",
    "tests/companion/test_engine_machine.py",
)
# The flights of any order of events take minutes where every call is looked at.
ARGUMENTS = (
    *("-p", "no:xdist", "-p", "no:cacheprovider"),
    *("--deselect", "tests/companion/test_sprayer_state.py::TestAnyFlight"),
)


def configuration() -> str:
    """Return what mutmut is told, as text of TOML."""
    copied = [*PACKAGES[1:], "tests", "deploy", "examples", "docs"]
    return "\n".join(
        (
            "\n[tool.mutmut]",
            f"source_paths = {json.dumps([PACKAGES[0]])}",
            f"only_mutate = {json.dumps(SOURCES)}",
            f"pytest_add_cli_args_test_selection = {json.dumps(TESTS)}",
            f"pytest_add_cli_args = {json.dumps(ARGUMENTS)}",
            f"also_copy = {json.dumps(copied)}",
            "",
        )
    )


def main(patterns: Sequence[str]) -> int:
    """Try the mutants, show the survivors; return 1 if there are any."""
    if not TOOL.exists():
        sys.stderr.write("no mutmut: make mutants-safety installs it\n")
        return 2
    with tempfile.TemporaryDirectory(prefix="vrspray-mutmut-") as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT))
        with (copy / "pyproject.toml").open("a") as file:
            file.write(configuration())
        _mutmut(copy, "run", "--max-children", "2", *(f"*{part}*" for part in patterns))
        survived = _survivors(_mutmut(copy, "results", quiet=True))
        for name in survived:
            _mutmut(copy, "show", name)
    sys.stdout.write(f"{len(survived)} survived\n")
    return 1 if survived else 0


def _survivors(results: str) -> list[str]:
    """Return the names of the mutants that no test noticed.

    >>> _survivors("    companion.a.x_b__mutmut_1: survived\\n    c: killed\\n")
    ['companion.a.x_b__mutmut_1']
    """
    lines = (line.strip().partition(": ") for line in results.splitlines())
    return [name for name, _, verdict in lines if verdict == "survived"]


def _mutmut(copy: Path, *arguments: str, quiet: bool = False) -> str:
    environment = os.environ | {"PYTHONPATH": f"{TOOL}"}
    done = subprocess.run(
        ["nice", "-n", "10", sys.executable, "-m", "mutmut", *arguments],
        cwd=copy,
        env=environment,
        check=False,
        text=True,
        stdout=subprocess.PIPE if quiet else None,
    )
    return done.stdout or ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

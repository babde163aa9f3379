"""Check the rules that keep the house easy to walk through: `python -m tests.house`.

A part of `make imports`. A module has two importers or a door of its own: a command, a name that
others load by, or an import inside a function (it is loaded only when it is asked for). One with a
single importer belongs into it, unless the two together pass 600 lines. What is an exception has
its reason here. No module has more than 600 lines.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("companion", "missions", "sitl", "analysis")
LINES_MAX = 600
# A module that has one importer and stays a file of its own, and why.
EXCEPTIONS: dict[str, str] = {
    "analysis.journals.salvage": "what is done to a journal, apart from the command line",
    "analysis.journals.stray_rows": "what a page may be of; pure, apart from the copy it serves",
    "missions.maps.cli.plan": "one sub-command a file",
    "companion.output.hardware_pwm": "one output a file",
    "missions.make.settled": "the optimum along a pass, apart from what it is of; pure",
    "missions.worth": "its price of a layout is another than the one that the layouts share",
    "sitl.stub.actions": "knows both firmwares' commands, which know the autopilot's protocol",
}
# Longer than 600 lines, to be cut; nothing is added here.
TOO_LONG: tuple[str, ...] = ()


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Return the file of every module of the four packages."""
    found = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def importers(files: dict[str, Path]) -> tuple[dict[str, set[str]], set[str]]:
    """Return who imports each module, and the modules that a function imports when it runs."""
    by: dict[str, set[str]] = defaultdict(set)
    asked_for: set[str] = set()
    for name, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        in_functions = {
            id(inner)
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for inner in ast.walk(node)
        }
        for node in ast.walk(tree):
            for target in _targets(node, files):
                by[target].add(name)
                if id(node) in in_functions:
                    asked_for.add(target)
    return by, asked_for


def _targets(node: ast.AST, files: dict[str, Path]) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names if alias.name in files]
    if not isinstance(node, ast.ImportFrom) or node.module is None:
        return []
    found = []
    for alias in node.names:
        full = f"{node.module}.{alias.name}"
        if full in files or node.module in files:
            found.append(full if full in files else node.module)
    return found


def named(root: Path, files: dict[str, Path]) -> set[str]:
    """Return the modules that are loaded by a name in a text: commands, formats, entry points."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    entry_points = project.get("entry-points", {})
    doors = {value.partition(":")[0] for group in entry_points.values() for value in group.values()}
    for user, path in files.items():
        package = user if path.name == "__init__.py" else user.rpartition(".")[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                word = node.value.partition(":")[0]
                doors |= {word, f"{package}.{word}"} & set(files)
    return doors


def findings(root: Path = ROOT) -> list[str]:
    """Return what breaks a rule, one line each."""
    files = modules(root)
    by, asked_for = importers(files)
    doors = named(root, files)
    size = {
        name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in files.items()
    }
    found = []
    for name, path in files.items():
        if size[name] > LINES_MAX and name not in TOO_LONG:
            found.append(f"{name}: {size[name]} lines, more than {LINES_MAX}")
        users = by[name] - {name}
        # What a package exports, and what `python -m` starts, are doors too.
        is_exported = any(files[user].name in ("__init__.py", "__main__.py") for user in users)
        is_door = name in doors or name in asked_for or path.name in ("__init__.py", "__main__.py")
        is_study = name.startswith("sitl.studies.")  # run by themselves: python -m ...
        if len(users) > 1 or is_study or is_exported or is_door or name in EXCEPTIONS:
            continue
        if not users:
            found.append(f"{name}: nobody imports it")
        elif size[name] + size[next(iter(users))] <= LINES_MAX:
            found.append(f"{name}: only {next(iter(users))} imports it: fold it into that")
    found += [f"{name}: no module, and an exception" for name in EXCEPTIONS if name not in files]
    return found


def main() -> int:
    """Print what breaks a rule; 1 if anything does."""
    found = findings()
    for line in found:
        sys.stdout.write(line + "\n")
    files = modules()
    sys.stdout.write(f"{len(files)} modules, {len(found)} findings, {len(EXCEPTIONS)} exceptions\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

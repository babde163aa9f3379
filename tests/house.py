"""Check the rules that keep the house easy to walk through: `python -m tests.house`.

A part of `make imports`. A module has two importers or a door of its own: a command, a name that
others load by, or an import inside a function (it is loaded only when it is asked for). One with a
single importer belongs into it, unless the two together pass 600 lines. What is an exception has
its reason here. No module has more than 600 lines, and no function says more than 60: from its
first statement to its end, without signature (a command's declares its options) and docstring.
A name that begins with `_` is its module's own: no other imports it (ruff sees `module._name`).
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("companion", "missions", "sitl", "analysis")
LINES_MAX = 600
# A module that has one importer and stays a file of its own, and why.
EXCEPTIONS: dict[str, str] = {
    "analysis.journals.salvage": "what is done to a journal, apart from the command line",
    "analysis.journals.stray_rows": "what a page may be of; pure, apart from the copy it serves",
}
# Longer than 600 lines, to be cut; nothing is added here.
TOO_LONG: tuple[str, ...] = ()
FUNCTION_LINES_MAX = 60
# A function that says more and stays one, and why.
LONG_FUNCTIONS: dict[str, str] = {
    "missions.cli.plan": "what is asked, planned, written and said, in that order",
    "missions.make.spots_cli.spots": "half of it is the answer, an entry a line",
    "missions.planner._planned": "each step of a plan takes what the one before it has found",
    "missions.refills._Run.__init__": "one table of a run's places, column after column",
}


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


def function_lines(path: Path) -> dict[str, int]:
    """Return how many lines each function says, by its name within the module."""
    found: dict[str, int] = {}

    def visit(node: ast.AST, within: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                name = f"{within}.{child.name}"
                if not isinstance(child, ast.ClassDef):
                    found[name] = _said(child)
                visit(child, name)
            else:
                visit(child, within)

    visit(ast.parse(path.read_text(encoding="utf-8")), "")
    return found


def _said(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    first, *rest = function.body
    is_docstring = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    begins = rest[0] if is_docstring and rest else first
    return (function.end_lineno or begins.lineno) - begins.lineno + 1


def long_functions(files: dict[str, Path]) -> list[str]:
    """Return the functions that are too long, and the exceptions that are none any more."""
    said = {
        module + name: lines
        for module, path in files.items()
        for name, lines in function_lines(path).items()
        if lines > FUNCTION_LINES_MAX
    }
    found = [
        f"{name}: {lines} lines, more than {FUNCTION_LINES_MAX}"
        for name, lines in said.items()
        if name not in LONG_FUNCTIONS
    ]
    return found + [
        f"{name}: no long function, and an exception" for name in LONG_FUNCTIONS if name not in said
    ]


def private_imports(files: dict[str, Path]) -> list[str]:
    """Return where a module imports what another keeps to itself: a name, or a whole module."""
    found = []
    for user, path in files.items():
        for name in imports(path.read_text(encoding="utf-8")):
            top, *parts = name.split(".")
            if top in PACKAGES and any(_is_private(part) for part in parts):
                found.append(f"{user}: imports {name}, which is private")
    return found


@cache
def imports(source: str) -> tuple[str, ...]:
    """Return the full name of all that a source imports, wherever it does so."""
    return tuple(_imports(source))


def _imports(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def findings(root: Path = ROOT) -> list[str]:
    """Return what breaks a rule, one line each."""
    files = modules(root)
    by, asked_for = importers(files)
    doors = named(root, files)
    size = {
        name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in files.items()
    }
    found: list[str] = []
    alone: dict[str, str] = {}
    for name, path in files.items():
        if size[name] > LINES_MAX and name not in TOO_LONG:
            found.append(f"{name}: {size[name]} lines, more than {LINES_MAX}")
        users = by[name] - {name}
        # What a package exports, and what `python -m` starts, are doors too.
        is_exported = any(files[user].name in ("__init__.py", "__main__.py") for user in users)
        is_door = name in doors or name in asked_for or path.name in ("__init__.py", "__main__.py")
        is_study = name.startswith("sitl.studies.")  # run by themselves: python -m ...
        if len(users) > 1 or is_study or is_exported or is_door:
            continue
        if not users:
            alone[name] = f"{name}: nobody imports it"
        elif size[name] + size[next(iter(users))] <= LINES_MAX:
            alone[name] = f"{name}: only {next(iter(users))} imports it: fold it into that"
    found += [line for name, line in alone.items() if name not in EXCEPTIONS]
    found += [
        f"{name}: an exception that nothing needs" for name in EXCEPTIONS if name not in alone
    ]
    return found + private_imports(files) + long_functions(files)


def main() -> int:
    """Print what breaks a rule; 1 if anything does."""
    found = findings()
    for line in found:
        sys.stdout.write(line + "\n")
    files = modules()
    exceptions = len(EXCEPTIONS) + len(LONG_FUNCTIONS)
    sys.stdout.write(f"{len(files)} modules, {len(found)} findings, {exceptions} exceptions\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

"""Check the rules that keep the house easy to walk through: `python -m tests.house`.

A part of `make imports`. Somebody imports each module, or loads it by its name: a command, an
entry point, `python -m`. No function says more than 60 lines: from its first statement to its end,
without signature (a command's declares its options) and docstring; what is an exception has its
reason here. A name that begins with `_` is its module's own: no other imports it (ruff sees
`module._name`). How much code a package may hold is in `weight.toml`.
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


def importers(files: dict[str, Path]) -> dict[str, set[str]]:
    """Return who imports each module, wherever in it."""
    by: dict[str, set[str]] = defaultdict(set)
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for target in _targets(node, files):
                by[target].add(name)
    return by


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
    by, doors = importers(files), named(root, files)
    unused = [
        f"{name}: nobody imports it"
        for name, path in files.items()
        if not by[name] - {name}
        and name not in doors
        and path.name not in ("__init__.py", "__main__.py")
    ]
    return unused + private_imports(files) + long_functions(files)


def main() -> int:
    """Print what breaks a rule; 1 if anything does."""
    found = findings()
    for line in found:
        sys.stdout.write(line + "\n")
    files = modules()
    exceptions = len(LONG_FUNCTIONS)
    sys.stdout.write(f"{len(files)} modules, {len(found)} findings, {exceptions} exceptions\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

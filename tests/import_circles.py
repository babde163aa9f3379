"""Find circles and arrows back up: `python -m tests.import_circles`, part of `make imports`.

Every import of the four packages counts, those for type checking and those inside functions too:
a file that cannot be understood without another one, and the other way round, is one file. An
arrow back up makes a circle of a folder: what its files build upon imports from the folder itself.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("companion", "missions", "sitl", "analysis")
# Circles that are still to be opened: take a name away with its last circle.
LEFT: tuple[str, ...] = ()

Graph = dict[str, set[str]]


def imports(root: Path = ROOT, packages: tuple[str, ...] = PACKAGES) -> Graph:
    """Return which module imports which, by their full names."""
    files = {
        _name(path.relative_to(root)): path
        for package in packages
        for path in sorted((root / package).rglob("*.py"))
    }
    return {
        name: {found for found in _imported(path, files) if found != name}
        for name, path in files.items()
    }


def _name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(path: Path, files: Mapping[str, Path]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in files)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            for alias in node.names:
                found = f"{node.module}.{alias.name}"
                if found in files:
                    yield found
                elif node.module in files:
                    yield node.module


def circles(graph: Graph) -> list[list[str]]:
    """Return the modules of each circle, by Tarjan's algorithm.

    >>> circles({"a": {"b"}, "b": {"c"}, "c": {"b"}})
    [['b', 'c']]
    """
    found: list[list[str]] = []
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in sorted(graph.get(name, ())):
            if other not in number:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            members = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(members) > 1:
                found.append(sorted(members))

    for name in sorted(graph):
        if name not in number:
            visit(name)
    return found


def arrows_up(graph: Graph, folders: Collection[str]) -> list[tuple[str, str]]:
    """Return (module, folder) where a folder's files import a module that imports from the folder.

    >>> graph = {"a.b.one": {"a.plan"}, "a.plan": {"a.b.two"}, "a.b.two": set(), "a.cli": {"a.b"}}
    >>> arrows_up(graph, ["a.b"])
    [('a.plan', 'a.b')]
    """
    found = []
    for folder in sorted(folders):
        inside = {name for name in graph if name == folder or name.startswith(f"{folder}.")}
        built_upon = {other for name in inside for other in graph[name]} - inside
        found += [(name, folder) for name in sorted(built_upon) if graph[name] & inside]
    return found


def main() -> int:
    """Name every circle that is not known, and every arrow back up; fail where there is one."""
    graph = imports()
    found = circles(graph)
    wrong = [
        f"circle of imports: {', '.join(members)}"
        for members in found
        if not set(members) & set(LEFT)
    ]
    folders = [name for name in graph if "." in name and (ROOT / name.replace(".", "/")).is_dir()]
    wrong += [
        f"arrow back up: {folder} builds upon {name}, which imports from {folder}"
        for name, folder in arrows_up(graph, folders)
    ]
    for line in wrong:
        sys.stderr.write(f"{line}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

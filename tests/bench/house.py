"""Measure the house: `python -m tests.bench.house [ROOT]`, of this checkout or of another one.

Files and code lines (no blank lines, comments or docstrings), what `run` loads, circles of imports.
Importing is measured in processes of its own, the best of five.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
from pathlib import Path

from tests import import_circles

PACKAGES = ("companion", "missions", "sitl", "analysis")
_NO_CODE = frozenset(
    {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    }
)
_LOADED = """
import resource, sys, time
sys.path.insert(0, {root!r})
began_s = time.process_time()
import companion.cli.run
took_s = time.process_time() - began_s
print(took_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
for module in list(sys.modules.values()):
    if module.__name__.split(".")[0] in {packages!r} and getattr(module, "__file__", None):
        print(module.__file__)
"""


def code_lines(path: Path) -> int:
    """Return how many lines of a file are code."""
    source = path.read_bytes()
    words: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if not isinstance(body, list) or not body or isinstance(node, ast.If | ast.For | ast.With):
            continue
        first = body[0]
        if isinstance(first, ast.Expr) and isinstance(getattr(first.value, "value", None), str):
            words |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    code: set[int] = set()
    for token in tokenize.tokenize(io.BytesIO(source).readline):
        if token.type not in _NO_CODE:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - words)


def is_empty(path: Path) -> bool:
    """Whether a file only makes a folder a package."""
    return path.name == "__init__.py" and code_lines(path) == 0


def loaded(root: Path, *, tries: int = 5) -> tuple[float, float, list[Path]]:
    """Return seconds of processor, megabytes, and our files that the import of `run` loads."""
    command = [sys.executable, "-c", _LOADED.format(root=str(root), packages=PACKAGES)]
    best: tuple[float, float, list[Path]] | None = None
    for _ in range(tries):
        found = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
        first, *files = found.stdout.splitlines()
        took_s, memory_mb = map(float, first.split())
        if best is None or took_s < best[0]:
            best = (took_s, memory_mb, [Path(file) for file in files])
    assert best is not None
    return best


def main() -> int:
    """Print the figures of a checkout."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else ".").resolve()
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    took_s, memory_mb, run_files = loaded(root)
    graph = import_circles.imports(root)
    folders = [name for name in graph if "." in name and (root / name.replace(".", "/")).is_dir()]
    kernel = list((root / "companion" / "core").glob("*.py"))
    rows = (
        ("product files", f"{len(files)}"),
        ("of these empty __init__.py", f"{sum(map(is_empty, files))}"),
        ("code lines", f"{sum(map(code_lines, files))}"),
        ("modules that `run` loads", f"{len(run_files)}"),
        ("their code lines", f"{sum(map(code_lines, run_files))}"),
        ("importing `run`, processor", f"{took_s:.2f} s"),
        ("importing `run`, memory", f"{memory_mb:.0f} MB"),
        ("files of companion/core itself", f"{len(kernel)}"),
        ("arrows back up", f"{len(import_circles.arrows_up(graph, folders))}"),
        ("circles of imports", f"{len(import_circles.circles(graph))}"),
    )
    for name, figure in rows:
        sys.stdout.write(f"{name:32} {figure}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

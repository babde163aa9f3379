"""What comes of strangers' files: every rule in every format, as `make files` found it."""

from __future__ import annotations

from tests.file_kinds.kinds import RULES
from tests.file_kinds.recorded import recorded

INTRODUCTION = """# Map files

What the program makes of the files of other programs: a table for each rule of reading, with a row for
each thing that such files do and a column for each format. The files are written by GDAL, pyarrow and
the package `isoxml` of npm, and every cell is tried by `make files`; none was read wrong in silence.

- **read**: as it is meant. **told**: as it is meant, with a word about it.
- **warned**: not as it is meant, and a warning or an error says so.
- **refused**: exit code 1 or 2, with what to do.

Where `--unit` is needed it was given. Codes of warnings are in [Map problems](map-problems.md).
"""
WORDS = {"right": "read", "said": "told", "warned": "warned", "refused": "refused"}


def page() -> str:
    """Return the page: a table a rule."""
    outcomes, parts = recorded(), [INTRODUCTION]
    for rule, kinds in RULES.items():
        found = outcomes[rule]
        formats = list(dict.fromkeys(name for kind in kinds for name in found.get(kind.name, {})))
        rows: dict[str, dict[str, set[str]]] = {}
        for kind in kinds:
            row = rows.setdefault(kind.row or kind.name, {})
            for name, outcome in found.get(kind.name, {}).items():
                row.setdefault(name, set()).add(WORDS[outcome])
        parts.append(f"\n## {rule}\n\n| | {' | '.join(formats)} |\n|---{'|---' * len(formats)}|")
        parts += [
            f"| {name} | {' | '.join(', '.join(sorted(row.get(one, ()))) for one in formats)} |"
            for name, row in rows.items()
        ]
    return "\n".join(parts)

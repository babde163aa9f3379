"""The report of the demo's flight, as `vrspray report` makes it of any journal."""

from __future__ import annotations

import importlib.util
from pathlib import Path

# What a report needs besides the program itself: the extra `report`.
NEEDED = ("jinja2", "matplotlib")


def can_report() -> bool:
    """Return whether all is installed that a report needs."""
    return all(importlib.util.find_spec(name) is not None for name in NEEDED)


def write_report(journal: Path, folder: Path) -> None:
    """Evaluate the flight in `journal` and write its report into `folder`."""
    from analysis.report.build import ReportOptions, build_report
    from analysis.report.folder import write_files

    write_files(folder, build_report(journal, ReportOptions()).files)

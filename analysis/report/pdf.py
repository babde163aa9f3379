"""The report on paper: the page itself, printed on A4 by a browser that is installed.

The page is the only design, and a browser prints it best. Nothing else is installed for it: where
there is no browser, the page can be printed on any other computer.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

from companion.errors import ConfigError

# Chromium and what is made of it; all take the same options.
BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "brave-browser",
)
WITHIN_S = 120.0
# No network, no first-run pages, nothing kept: the page is whole by itself.
_OPTIONS = (
    "--headless",
    "--disable-gpu",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--no-pdf-header-footer",
)


def browser(which: Callable[[str], str | None] = shutil.which) -> str:
    """Return a browser that prints; ConfigError, in one line, where none is installed."""
    found = next((path for name in BROWSERS if (path := which(name))), None)
    if found is None:
        raise ConfigError(
            "--pdf: no Chromium or Chrome is installed; install chromium, or leave --pdf out and "
            "print report.html from any browser"
        )
    return found


def pdf_of(page: str, *, program: str | None = None) -> bytes:
    """Return a page as PDF; ConfigError where the browser does not make one."""
    program = program or browser()
    with tempfile.TemporaryDirectory(prefix="vrspray-pdf-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        source, target = folder / "report.html", folder / "report.pdf"
        source.write_text(page, encoding="utf-8")
        # A browser refuses its sandbox to root, who needs none against a page of our own.
        is_root = hasattr(os, "geteuid") and os.geteuid() == 0
        command = [
            program,
            *_OPTIONS,
            *(["--no-sandbox"] if is_root else []),
            f"--user-data-dir={folder / 'profile'}",
            f"--print-to-pdf={target}",
            source.as_uri(),
        ]
        try:
            subprocess.run(command, capture_output=True, timeout=WITHIN_S, check=False)
            found = target.read_bytes()
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigError(
                f"--pdf: {program} did not print the page; print report.html from a browser"
            ) from error
    return found

"""The command line `vrspray`: the composition root, the one place that knows everything.

`app` has the table of commands and turns errors into one line and an exit code; each group of
commands is a module that is imported when it is asked for.
"""

from __future__ import annotations

from companion.cli.app import main

__all__ = ["main"]

"""Pictures look as this program draws them, whatever folder it is started in.

Matplotlib takes a file `matplotlibrc` of the working directory before all others, even before the
user's own, and with `text.usetex` such a file starts TeX with a preamble of its own. Who opens a
stranger's folder of maps has not asked for that.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType

_NAME = "matplotlib"


class _Finder(MetaPathFinder):
    """Finds matplotlib where it is, and has it imported from elsewhere."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        if fullname != _NAME:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        with _in_root():
            super().exec_module(module)


@contextmanager
def _in_root() -> Iterator[None]:
    # By its descriptor: the name of the folder may be gone.
    here = os.open(".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.chdir("/")
        try:
            yield
        finally:
            os.fchdir(here)
    finally:
        os.close(here)


def ignore_the_folders_own() -> None:
    """Have matplotlib, once it is imported, read no file of the working directory."""
    sys.meta_path.insert(0, _Finder())

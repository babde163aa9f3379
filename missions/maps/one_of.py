"""Which file of a folder or an archive is the map, where there may be several of a kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

from missions.maps.bundle import Bundle
from missions.maps.model import map_error


def one_of(bundle: Bundle, names: Sequence[str], layer: str | None, *, kind: str) -> str:
    """Return the only file, or the one that `layer` names: by its stem, or by its place."""
    meant = [name for name in names if layer is None or layer in _calls(name)]
    if len(meant) == 1:
        return meant[0]
    stems = Counter(PurePosixPath(name).stem for name in names)
    shown = [
        PurePosixPath(name).stem if stems[PurePosixPath(name).stem] == 1 else name for name in names
    ]
    listed = ", ".join(shown[:8]) + (f" and {len(shown) - 8} more" if len(shown) > 8 else "")
    if not names:
        raise map_error(
            bundle.path, f"it holds no {kind}", fix="name the map's own file",
            code="unknown-format",
        )  # fmt: skip
    raise map_error(
        bundle.path,
        f"it holds the {kind} files {listed}" + ("" if meant else f", and no {layer!r}"),
        fix="name one of them with --layer (prescription.layer)",
        code="several-layers" if meant else "no-layer",
    )


def _calls(name: str) -> tuple[str, str, str]:
    place = PurePosixPath(name)
    return place.stem, place.name, name

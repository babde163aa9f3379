"""What the program makes of a file, beside what is true of it."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.cli.app import execute
from tests.file_kinds.kind import REFUSED, RIGHT, SAID, WARNED, Kind
from tests.file_kinds.writers import Writer

# A rate may differ by rounding alone; an area by the plane in which it is counted.
RATE_SHARE = 1e-4
AREA_SHARE = 1e-3
# What is said of sound files too, and so warns nobody of what is wrong.
BENIGN = ("datum", "hole", "low-rate")


@dataclass(frozen=True, kw_only=True)
class Found:
    """What came of one file."""

    kind: Kind
    format: str
    outcome: str
    text: str

    @property
    def fine(self) -> bool:
        """Tell whether it may be so."""
        return self.outcome in self.kind.may

    def __str__(self) -> str:
        return f"{self.kind.name} | {self.format} | {self.outcome} | {self.text}"


def asked(*arguments: str) -> tuple[int, dict[str, Any]]:
    """Run a command with --json."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = execute([*arguments, "--json"])
    return code, json.loads(out.getvalue())


def judged(kind: Kind, name: str, write: Writer, folder: Path) -> Found:
    """Write one file and return what came of it."""
    ground = kind.make()
    path = write(ground, folder)
    if kind.spoil is not None:
        kind.spoil(path)
    outcome, text = _planned(kind, path) if kind.outline else _mapped(kind, path, folder)
    return Found(kind=kind, format=name, outcome=outcome, text=text)


def _planned(kind: Kind, path: Path) -> tuple[str, str]:
    out = path.parent / "out.plan"
    code, found = asked(
        "plan", str(path), "--rate-l-ha", "20", "--out", str(out), "--force", "--holes", "over"
    )
    if code == 2:
        return REFUSED, found["error"]
    true = kind.make().area_m2 or 0.0
    area = 10_000 * found["area_ha"]
    said = [str(each) for each in found["warnings"]]
    text = f"{area:.0f} of {true:.0f} m2 {said}"
    return _named(right=abs(area - true) <= 2 * AREA_SHARE * true, said=bool(said)), text


def _named(*, right: bool, said: bool) -> str:
    if right:
        return SAID if said else RIGHT
    return WARNED if said else "wrong"


def _mapped(kind: Kind, path: Path, folder: Path) -> tuple[str, str]:
    code, found = asked("map", "check", str(path), *kind.options)
    if code == 2:
        return REFUSED, found["error"]
    said = [problem["code"] for problem in found["problems"] if problem["code"] not in BENIGN]
    if code == 1:
        return REFUSED, f"{said}"
    wrong = _wrong(kind, path, folder, found)
    return _named(right=not wrong, said=bool(said)), f"{said} {wrong}"


def _wrong(kind: Kind, path: Path, folder: Path, found: dict[str, Any]) -> str:
    """Return what is not as it was written; nothing: all is."""
    ground = kind.make()
    places = ground.places()
    points = folder / "asked.txt"
    points.write_text("lat,lon\n" + "".join(f"{y:.10f},{x:.10f}\n" for x, y, _ in places))
    code, rows = asked("map", "rate", str(path), "--points", str(points), *kind.options)
    if code != 0:
        return f"map rate: {rows.get('error', rows)}"
    for (x, y, rate), row in zip(places, rows["points"], strict=True):
        read = row["rate_l_ha"]
        same = read is None if rate is None else read is not None and _near(read, rate)
        if not same:
            return f"{read} for {rate} at {y:.6f}, {x:.6f}"
    if ground.area_m2 is None:
        return ""
    area = 10_000 * found["area_ha"]
    if abs(area - ground.area_m2) > AREA_SHARE * ground.area_m2:
        return f"{area:.1f} m2 for {ground.area_m2:.1f}"
    return ""


def _near(read: float, rate: float) -> bool:
    return abs(read - rate) <= RATE_SHARE * max(rate, 1.0)

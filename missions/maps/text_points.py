"""P2's open text map, as it stands in the file: a count, then one point with a rate on each line.

    NP
    latitude <tab> longitude <tab> altitude <tab> rate

Degrees on WGS 84, south and west negative; metres; L/min (Rovira-Más et al. 2024, figure 1).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from companion.wording import iconv
from missions.maps.model import cut_off, map_error, write_whole

# The local tangent plane of P2's maps: metres east, north and up of an origin that is chosen.
#
# P2 (Rovira-Más et al. 2024) goes from latitude, longitude and altitude through earth-centred,
# earth-fixed X, Y, Z to a plane that touches the earth at the origin, on the WGS 84 ellipsoid.
# The core's `LocalFrame` is a map projection instead. From the same origin, on the ellipsoid, the
# two differ by up to d^3 / (3 R^2): 8 micrometres at 1 km, 1 mm at 5 km. But the tangent plane
# stretches with altitude, by h / R (0.1 m per km at 640 m), and leans with the distance of
# its origin; so its cells are tied to the ground by their corners (`text_map.py`).

# Each round divides what is left by some hundreds: nine leave nothing of a metre.
_ROUNDS = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class TangentPlane:
    """East, north and up [m] of an origin.

    >>> plane = TangentPlane(latitude_deg=39.4829175, longitude_deg=-0.337570611, altitude_m=5.007)
    >>> east, north, up = plane.to_local(
    ...     np.array([39.4829515]), np.array([-0.337544528]), np.array([5.644])
    ... )
    >>> round(float(east[0]), 3), round(float(north[0]), 3), round(float(up[0]), 3)
    (2.244, 3.775, 0.637)
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0
    _forward: Transformer = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 180.0):
            raise ValueError(f"origin is not a position: {self.latitude_deg}, {self.longitude_deg}")
        if not math.isfinite(self.altitude_m):
            raise ValueError(f"origin has no altitude: {self.altitude_m}")
        forward = Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +h_0={self.altitude_m!r}"
        )
        object.__setattr__(self, "_forward", forward)

    def to_local(
        self, latitude_deg: Floats, longitude_deg: Floats, altitude_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return east, north and up of many points."""
        east, north, up = self._forward.transform(longitude_deg, latitude_deg, altitude_m)
        return east, north, up

    def to_geodetic(
        self, east_m: Floats, north_m: Floats, up_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return latitude [deg], longitude [deg] and altitude [m] of many points."""
        longitude_deg, latitude_deg, altitude_m = self._forward.transform(
            east_m, north_m, up_m, direction="INVERSE"
        )
        return latitude_deg, longitude_deg, altitude_m

    def on_ground(
        self, east_m: Floats, north_m: Floats, altitude_m: float
    ) -> tuple[Floats, Floats]:
        """Return latitude and longitude [deg] of what lies at an altitude over east and north."""
        up_m = np.full(len(east_m), altitude_m - self.altitude_m)
        for _ in range(_ROUNDS):
            latitude, longitude, found_m = self.to_geodetic(east_m, north_m, up_m)
            up_m += altitude_m - found_m
        return latitude, longitude


Floats = NDArray[np.float64]

MAX_POINTS = 1_000_000
# A sprayer for orchards gives at most some 100 L/min; this only keeps numbers in bounds.
FLOW_MAX_L_MIN = 100_000.0
# From below the shores of the Dead Sea to above all mountains.
ALTITUDE_MIN_M, ALTITUDE_MAX_M = -500.0, 9_000.0
_SEVERAL = "write tabs between the four numbers and a point in them, not a comma"
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
_COMMA = re.compile(r"[+-]?\d+,\d", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class TextMap:
    """The points of a map in the order of the file; all arrays of one length."""

    latitude_deg: Floats
    longitude_deg: Floats
    altitude_m: Floats
    rate_l_min: Floats

    def __post_init__(self) -> None:
        counts = {
            len(values)
            for values in (
                self.latitude_deg, self.longitude_deg, self.altitude_m, self.rate_l_min,
            )
        }  # fmt: skip
        if len(counts) != 1 or not 0 < self.count <= MAX_POINTS:
            raise ValueError(f"no points of a map: {sorted(counts)}")

    @property
    def count(self) -> int:
        """Return NP."""
        return len(self.latitude_deg)


def parse_text_map(content: bytes, path: Path) -> TextMap:
    """Return the points of a file, or refuse it with the line that is wrong."""
    lines = _lines(content, path)
    if not lines:
        raise map_error(
            path, "the file is empty", fix="write the number of points, then the points",
            code="truncated",
        )  # fmt: skip
    count = _count(lines[0], path)
    rows = lines[1:]
    if len(rows) != count and rows:
        _check_rows(rows[-1:], path, last=rows[-1][0])
    if len(rows) != count:
        raise map_error(
            path,
            f"the first line says {count} points, but {len(rows)} follow",
            fix="add what is missing, or correct the number in the first line",
            code="wrong-count",
        )
    table = _table(rows, path)
    if rows[-1][1][-1] in "0123456789." and not content.endswith((b"\n", b"\r")):
        raise cut_off(path, rows[-1][0], rows[-1][1].split()[-1])
    _check_values(table, [number for number, _ in rows], path)
    latitude, longitude, altitude, rate = table.T
    return TextMap(
        latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude, rate_l_min=rate
    )


def _lines(content: bytes, path: Path) -> list[tuple[int, str]]:
    """Return the number and the text of every line that is not blank."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise map_error(
            path, "this is not plain text", code="encoding",
            fix=f"save it as plain text in UTF-8, or: {iconv(content, path)}",
        )  # fmt: skip
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return [(number, line) for number, line in enumerate(lines, 1) if line and not line.isspace()]


def _count(first: tuple[int, str], path: Path) -> int:
    words = first[1].split()
    if len(words) != 1 and all(_NUMBER.fullmatch(word) for word in words):
        raise map_error(
            path,
            f"line {first[0]} is not the number of points",
            fix="write the number of points alone on the first line",
            code="wrong-count",
        )
    if len(words) != 1 or not re.fullmatch(r"\d{1,9}", words[0], re.ASCII):
        if len(words) == 1 and _COMMA.match(words[0]):
            raise _comma(path, *first)
        raise map_error(
            path,
            f"line {first[0]} is {first[1].strip()[:40]!r}, so this is not an open text map, which "
            "begins with the number of its points",
            fix="name another file, or see docs/howto/text-map.md for the format",
            code="unknown-format",
        )
    count = int(words[0])
    if not 0 < count <= MAX_POINTS:
        raise map_error(
            path,
            f"{count} points are not between 1 and {MAX_POINTS}",
            fix="cut the map to one field",
            code="wrong-count" if count == 0 else "too-large",
        )
    return count


def _table(rows: list[tuple[int, str]], path: Path) -> Floats:
    """Return (points, 4) numbers; a line that does not give four is looked for and named."""
    texts = [line for _, line in rows]
    try:
        table = np.loadtxt(texts, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape != (len(rows), 4) or not np.isfinite(table).all():
        _check_rows(rows, path, last=rows[-1][0])
        raise map_error(path, "its numbers cannot be read", fix=_SEVERAL, code="bad-number")
    return table


def _check_rows(rows: list[tuple[int, str]], path: Path, *, last: int) -> None:
    """Refuse the first of the lines that is not four numbers."""
    for number, line in rows:
        words = line.split()
        if any(_COMMA.match(word) for word in words):
            raise _comma(path, number, line)
        wrong = next((word for word in words if not _NUMBER.fullmatch(word)), None)
        if wrong is not None or not np.isfinite([float(word) for word in words]).all():
            shown = wrong or line.strip()
            raise map_error(
                path,
                f"line {number}: {shown[:40]!r} is not a number",
                fix=_SEVERAL,
                code="bad-number",
            )
        if len(words) != 4:
            cut = number == last and len(words) < 4
            raise map_error(
                path,
                f"line {number} has {len(words)} numbers instead of latitude, longitude, altitude "
                "and rate" + (", and is the last: the file is cut short" if cut else ""),
                fix="copy the file again" if cut else _SEVERAL,
                code="truncated" if cut else "bad-line",
            )


def _comma(path: Path, number: int, line: str) -> Exception:
    return map_error(
        path,
        f"line {number} holds a comma: {line.strip()[:40]!r}",
        fix=_SEVERAL,
        code="decimal-comma",
    )


def _check_values(table: Floats, numbers: list[int], path: Path) -> None:
    """Refuse what is no place on earth or no rate."""
    latitude, longitude, altitude, rate = table.T

    def refuse(wrong: NDArray[np.bool_], text: str, *, fix: str, code: str) -> None:
        if wrong.any():
            index = int(np.flatnonzero(wrong)[0])
            values = " ".join(f"{value:.10g}" for value in table[index])
            where = f"line {numbers[index]} ({values})"
            raise map_error(path, f"{where}: {text}", fix=fix, code=code)

    exchanged = bool((np.abs(longitude) <= 90.0).all() and (np.abs(latitude) <= 180.0).all())
    refuse(
        np.abs(latitude) > 90.0,
        "no latitude is beyond 90 degrees"
        + ("; latitude and longitude look exchanged" if exchanged else ""),
        fix="write the latitude first, in degrees" if exchanged else "write degrees",
        code="swapped-axes" if exchanged else "out-of-range",
    )
    refuse(
        np.abs(longitude) > 180.0,
        "no longitude is beyond 180 degrees",
        fix="write degrees, west of Greenwich negative",
        code="out-of-range",
    )
    refuse(
        ~((altitude >= ALTITUDE_MIN_M) & (altitude <= ALTITUDE_MAX_M)),
        f"the altitude is not between {ALTITUDE_MIN_M:g} and {ALTITUDE_MAX_M:g} m",
        fix="write metres above the ellipsoid in the third column",
        code="out-of-range",
    )
    refuse(
        ~((rate >= 0.0) & (rate < FLOW_MAX_L_MIN)),
        "the rate is none",
        fix="write L/min in the fourth column; leave out points without a rate",
        code="bad-rate",
    )


def text_of(points: TextMap) -> str:
    """Return the file: ten decimals of a degree (11 micrometres), as P2's own maps have."""
    rows = zip(
        points.latitude_deg.tolist(),
        points.longitude_deg.tolist(),
        points.altitude_m.tolist(),
        points.rate_l_min.tolist(),
        strict=True,
    )
    lines = [
        f"{latitude:.10f}\t{longitude:.10f}\t{altitude:.3f}\t{_plain(rate)}"
        for latitude, longitude, altitude, rate in rows
    ]
    return "\n".join([str(points.count), *lines, ""])


def _plain(rate_l_min: float) -> str:
    """Return a rate to a billionth of a litre per minute, without zeros behind it."""
    return f"{rate_l_min:.9f}".rstrip("0").rstrip(".")


def write_text_map(points: TextMap, path: Path) -> None:
    """Write a map, whole or not at all."""
    write_whole(path, text_of(points).encode("ascii"))

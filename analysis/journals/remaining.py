"""`vrspray flights remaining`: what earlier flights leave of a field, and where they stopped."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
import typer
from shapely import MultiPolygon

from analysis.journals.content import damages
from companion.atomic_write import write_atomically
from companion.cli.answer import AsJson, answer, note
from companion.core.frame import LocalFrame
from companion.core.options.coverage import Coverage
from companion.core.prescription import Prescription
from companion.errors import VrsprayError
from companion.flight_map.child import flight_map_of_file
from companion.journal.continuing import Treated, rest_of, treated_ground_of
from companion.journal.coverage import moved
from companion.journal.reader import opened
from companion.journal.writer import missing_rows
from companion.map_formats import DEGREE_DECIMALS, geojson_feature, geojson_text

M2_PER_HA = 10_000.0
# The mean rate of the rest is taken at so many places of it.
PLACES = 40_000
PLACE_MIN_M = 0.5


def remaining(
    journals: Annotated[
        list[Path],
        typer.Argument(metavar="JOURNAL...", help="Journals (.gpkg) of all flights of the job."),
    ],
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", help="Prescription map; default: that of the last flight."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE.geojson", help="Write the untreated ground and the resume point."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what is treated, what is left in hectares and litres, and where to resume.

    What is left in pieces narrower than half a valve's strip does not count: no valve is for that.

    Exit 0: all was read; 1: a journal is damaged or of another version, and what could
    not be read is listed; 2: no journal, or none that keeps treated ground.
    """
    flights = sorted((_treated(path) for path in journals), key=_started)
    last = flights[-1]
    for line in _training(flights):
        note(line)
    ground, frame = last.setup.prescription, last.frame
    if map_file is not None:
        flight_map = flight_map_of_file(map_file, overlap="max")
        ground, frame = flight_map.prescription, flight_map.frame
    treated = Coverage()
    for flight in flights:
        treated = treated.joined(moved(flight.coverage, flight.frame, frame))
    rest = rest_of(ground.field, treated, last.strip_m)
    result = _result(flights, ground, treated, rest)
    if out is not None:
        _write(out, rest, frame, result)
        result["file"] = str(out)
    answer(result, _lines(result), as_json=as_json)
    for text in result["unread"]:
        note(f"not read: {text}")
    if result["unread"]:
        raise typer.Exit(1)


def _treated(path: Path) -> Treated:
    """Return what a flight treated, as far as it can be read; JournalError where it is none."""
    with opened(path, is_lenient=True) as journal:
        unread = [*journal.unread, *damages(journal.connection)]
        unread += missing_rows(journal.connection, journal.meta)
        return treated_ground_of(journal, unread)


def _training(flights: Sequence[Treated]) -> Iterator[str]:
    """Yield which flights treated nothing, and of which nobody says."""
    for flight in flights:
        if flight.training is None:
            yield (
                f"warning: {flight.path}: does not say whether a product was sprayed: "
                "`vrspray run --continue` takes it with --continue-unmarked only"
            )
        elif flight.training != "no":
            yield (
                f"warning: {flight.path}: flown with training = {flight.training}: no product; "
                "`vrspray run --continue` refuses it"
            )


def _started(flight: Treated) -> str:
    return flight.started_utc


def _result(
    flights: Sequence[Treated], ground: Prescription, treated: Coverage, rest: MultiPolygon
) -> dict[str, Any]:
    last = flights[-1]
    area_m2, litres = _demand(ground, rest)
    stopped = next((flight.stopped for flight in reversed(flights) if flight.stopped), None)
    return {
        "journals": [str(flight.path) for flight in flights],
        "field_ha": ground.field.area / M2_PER_HA,
        "treated_ha": treated.area_m2 / M2_PER_HA,
        "remaining_ha": area_m2 / M2_PER_HA,
        "remaining_l": litres,
        "pieces": len(rest.geoms),
        "narrowest_m": 0.5 * last.strip_m,
        "resume": None if stopped is None else _place(*stopped),
        # Cut off: its last second is a guess; damaged: more was treated than could be read.
        "is_exact": all(flight.is_closed and not flight.unread for flight in flights),
        "training": [flight.training for flight in flights],
        "unread": [f"{flight.path}: {text}" for flight in flights for text in flight.unread],
    }


def _demand(ground: Prescription, rest: MultiPolygon) -> tuple[float, float]:
    """Return the area [m2] that wants liquid, and how much of it [L]."""
    if rest.is_empty:
        return 0.0, 0.0
    step_m = max(PLACE_MIN_M, math.sqrt(rest.area / PLACES))
    west, south, east, north = rest.bounds
    x, y = np.meshgrid(
        np.arange(west + 0.5 * step_m, east, step_m), np.arange(south + 0.5 * step_m, north, step_m)
    )
    shapely.prepare(rest)
    inside = shapely.contains_xy(rest, x.ravel(), y.ravel())
    if not inside.any():
        return 0.0, 0.0
    rates = np.nan_to_num(ground.rates_at(x.ravel()[inside], y.ravel()[inside]))
    return rest.area * float((rates > 0.0).mean()), rest.area * float(rates.mean()) / M2_PER_HA


def _lines(result: Mapping[str, Any]) -> Iterator[str]:
    yield f"treated {result['treated_ha']:.3f} of {result['field_ha']:.3f} ha"
    yield (
        f"left {result['remaining_ha']:.3f} ha, {result['remaining_l']:.2f} L, in "
        f"{result['pieces']} pieces; none narrower than {result['narrowest_m']:g} m is counted"
    )
    place = result["resume"]
    if place is not None:
        yield f"stopped at {place['lat']:.7f},{place['lon']:.7f}"
    if result["unread"]:
        yield "a journal is damaged: more may be treated than could be read"
    elif not result["is_exact"]:
        yield "a flight was cut off: what it sprayed after the end of its journal is not known"


def _place(latitude_deg: float, longitude_deg: float) -> dict[str, float]:
    """Return a place as it is written, too."""
    return {
        "lat": round(latitude_deg, DEGREE_DECIMALS),
        "lon": round(longitude_deg, DEGREE_DECIMALS),
    }


def _write(out: Path, rest: MultiPolygon, frame: LocalFrame, result: Mapping[str, Any]) -> None:
    """Write the rest as polygons in longitude and latitude, and the place to go on from."""

    def there(places: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, Any]:
        latitude, longitude = frame.to_geographic_all(places[:, 0].tolist(), places[:, 1].tolist())
        return np.stack([longitude, latitude], axis=1)

    features = [
        geojson_feature(
            shapely.transform(piece, there),
            {"kind": "remaining", "area_m2": round(piece.area, 1)},
        )
        for piece in rest.geoms
    ]
    place = result["resume"]
    if place is not None:
        features.append(
            geojson_feature(shapely.Point(place["lon"], place["lat"]), {"kind": "resume"})
        )
    try:
        write_atomically(out, geojson_text(features).encode())
    except OSError as error:
        raise VrsprayError(f"{out}: cannot be written: {error}") from error

"""`vrspray trial`: the trial that `vrspray make trial` laid out, after flight and harvest."""

from __future__ import annotations

import csv
import importlib.util
import json
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import shapely
import typer

from companion.atomic_write import write_atomically
from companion.cli.answer import AsJson, answer, new_app, note
from companion.csv_table import csv_of
from companion.errors import VrsprayError
from companion.wording import counted, missing, writing

if TYPE_CHECKING:
    from analysis.strips import Strip
    from analysis.trial import Achieved, Floats, Plot
    from companion.core.frame import LocalFrame

VERSION = 1
# What stands for latitude and longitude at the head of a CSV file's columns.
LATITUDE = ("lat", "latitude", "latitude_deg", "y")
LONGITUDE = ("lon", "lng", "long", "longitude", "longitude_deg", "x")
FILE_MAX_BYTES = 500_000_000


class TrialError(VrsprayError):
    """A trial or its harvest cannot be read."""


app = new_app()


@app.command(
    epilog="Example: vrspray trial flights/flight-0001.gpkg --plots trial.trial.geojson "
    "--harvest yield.csv --value yield_t_ha"
)
def evaluate_trial(
    journals: Annotated[
        list[Path], typer.Argument(metavar="JOURNAL...", help="All flights over the plots.")
    ],
    plots_file: Annotated[
        Path,
        typer.Option(
            "--plots", metavar="FILE", help="NAME.trial.geojson, which `make trial` wrote."
        ),
    ],
    harvest: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Harvest points: .csv with lat and lon, or .shp."),
    ] = None,
    value: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="Column of the harvest points with the yield."),
    ] = None,
    tolerance_percent: Annotated[
        float,
        typer.Option(
            metavar="PCT", help="A plot whose rate is further off fails.", min=0.1, max=100.0
        ),
    ] = 10.0,
    covered_percent: Annotated[
        float,
        typer.Option(
            metavar="PCT", help="A plot with less of it sprayed fails.", min=1.0, max=100.0
        ),
    ] = 90.0,
    position_m: Annotated[
        float, typer.Option(metavar="M", help="Error of positions, 1 sd.", min=0.0, max=10.0)
    ] = 0.05,
    lag_s: Annotated[
        float, typer.Option(metavar="S", help="Error of the lags, 1 sd.", min=0.0, max=1.0)
    ] = 0.02,
    meter_percent: Annotated[
        float,
        typer.Option(metavar="PCT", help="Error of flow meter or curve, 1 sd.", min=0.0, max=50.0),
    ] = 3.0,
    keep_failed: Annotated[
        bool, typer.Option("--keep-failed", help="Compare yields of plots that failed, too.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Table with one row for each plot.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate a trial: the rate each plot got, which plots failed, and yields by treatment.

    Exit 0: evaluated; 1: plots failed, or yields cannot be compared; 2: a file cannot be used.
    """
    from analysis.trial import Errors, Tolerance, achieved, half_intervals

    if (harvest is None) != (value is None):
        raise typer.BadParameter("--harvest and --value go together")
    if harvest is not None and importlib.util.find_spec("statsmodels") is None:
        raise TrialError(missing("statsmodels"))
    trial, features = read_trial(plots_file)
    strips, frame = _flown(journals)
    plots = local_plots(features, frame)
    tolerance = Tolerance(rate_percent=tolerance_percent, covered_percent=covered_percent)
    found = achieved(plots, strips, tolerance)
    errors = Errors(
        position_m=position_m, lag_s=lag_s, speed_m_s=float(trial.get("speed_m_s") or 0.0),
        meter_percent=meter_percent,
    )  # fmt: skip
    halves = half_intervals(found, strips, errors)
    result: dict[str, Any] = {
        "trial": trial,
        "journals": [str(path) for path in journals],
        "plots": [_row(one, half) for one, half in zip(found, halves, strict=True)],
        "errors": {"position_m": position_m, "lag_s": lag_s, "meter_percent": meter_percent},
        "failed": sum(bool(one.reasons) for one in found),
        "yield": None,
    }
    lines = [_line(one, half) for one, half in zip(found, halves, strict=True)]
    lines.append(
        f"95 % intervals: positions {position_m:g} m, lags {lag_s:g} s, meter {meter_percent:g} %, "
        "1 sd each; the meter's is one factor for all plots"
    )
    if harvest is not None and value is not None:
        lines += _yields(result, found, harvest, value, frame, keep_failed=keep_failed)
    if out is not None:
        _write_table(out, result["plots"])
        lines.append(f"written: {out}")
    answer(result, lines, as_json=as_json)
    compared = harvest is None or result["yield"]["means"] is not None
    raise typer.Exit(0 if not result["failed"] and compared else 1)


def read_trial(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the design of a trial and the features of the plots' inner parts."""
    try:
        if path.stat().st_size > FILE_MAX_BYTES:
            raise TrialError(f"{path}: too large for a trial; give the file of `make trial`")
        text = json.loads(path.read_text(encoding="utf-8"))
        trial, features = text["trial"], text["features"]
        if trial["version"] != VERSION:
            raise TrialError(f"{path}: of version {trial['version']}, this program reads {VERSION}")
        inner = [one for one in features if one["properties"]["part"] == "inner"]
        for one in inner:
            float(one["properties"]["rate_l_ha"]), int(one["properties"]["block"])
            int(one["properties"]["plot"])
    except FileNotFoundError:
        raise TrialError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise TrialError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        raise TrialError(
            f"{path}: this is not a trial; give the NAME.trial.geojson of `vrspray make trial`"
        ) from None
    if not inner:
        raise TrialError(f"{path}: has no plots; make the trial again")
    return trial, inner


def local_plots(features: Sequence[dict[str, Any]], frame: LocalFrame) -> list[Plot]:
    """Return the plots in metres around the origin of the flight."""
    from analysis.trial import Plot

    def there(points: Floats) -> Floats:
        return _local(points[:, 1], points[:, 0], frame)

    found = []
    for one in features:
        try:
            area = shapely.from_geojson(json.dumps(one["geometry"]))
        except (shapely.errors.ShapelyError, ValueError):
            area = None
        if area is None or area.is_empty or not area.area > 0.0:
            raise TrialError(
                f"plot {one['properties']['plot']} has no ground; make the trial again"
            )
        found.append(
            Plot(
                number=int(one["properties"]["plot"]), block=int(one["properties"]["block"]),
                rate_l_ha=float(one["properties"]["rate_l_ha"]),
                inner=shapely.transform(area, there),
            )
        )  # fmt: skip
    return found


def _local(latitude_deg: Floats, longitude_deg: Floats, frame: LocalFrame) -> Floats:
    east, north = frame.to_local_all(latitude_deg.tolist(), longitude_deg.tolist())
    return np.column_stack([east, north])


def _flown(journals: Sequence[Path]) -> tuple[list[Strip], LocalFrame]:
    """Return the strips of all flights, around the origin of the first one."""
    from analysis.flown.applied_record import record_of
    from analysis.flown.read_applied import read_applied
    from analysis.strips import strips_of

    strips: list[Strip] = []
    frame = None
    for path in journals:
        flight = read_applied(path)
        own = flight.setup.frame
        if frame is None:
            frame = own
        elif (own.latitude_deg, own.longitude_deg) != (frame.latitude_deg, frame.longitude_deg):
            raise TrialError(f"{path}: was flown with another map than {journals[0]}")
        strips += strips_of(record_of(flight))
    assert frame is not None
    return strips, frame


def _yields(
    result: dict[str, Any], found: Sequence[Achieved], path: Path, value: str, frame: LocalFrame,
    *, keep_failed: bool,
) -> list[str]:  # fmt: skip
    """Add the yields to the result, and return them in words."""
    from analysis.trial import plot_means, treatment_means

    latitude, longitude, values = read_harvest(path, value)
    means = plot_means([one.plot for one in found], _local(latitude, longitude, frame), values)
    for row, (points, mean) in zip(result["plots"], means, strict=True):
        row["harvest_points"], row["yield"] = points, mean
    used = [
        (one.plot, mean)
        for one, (_, mean) in zip(found, means, strict=True)
        if mean is not None and (keep_failed or not one.reasons)
    ]
    compared = treatment_means(
        [plot.rate_l_ha for plot, _ in used], [plot.block for plot, _ in used],
        [mean for _, mean in used], result["trial"].get("check_l_ha"),
    )  # fmt: skip
    result["yield"] = {"column": value, "plots": len(used), "means": compared}
    if compared is None:
        note(
            f"error: {counted(len(used), 'plot')} with harvest points and without faults are too "
            "few to compare; look at the plots above, or --keep-failed"
        )
        return []
    lines = [
        f"{value}: least-squares means of {len(used)} plots with 95 % intervals, "
        f"{compared['degrees_of_freedom']} degrees of freedom; p = {compared['p_value']:.3g}"
    ]
    lines += [_interval(one, "") for one in compared["treatments"]]
    lines += [_interval(one, " against the check") for one in compared["against_check"] or ()]
    return lines


def _interval(one: dict[str, float], what: str) -> str:
    return (
        f"  {one['rate_l_ha']:g} L/ha{what}: {one['value']:.3f} "
        f"({one['low']:.3f} to {one['high']:.3f})"
    )


def read_harvest(path: Path, value: str) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude and value of harvest points; those without a value are not in."""
    try:
        if path.stat().st_size > FILE_MAX_BYTES:
            raise TrialError(f"{path}: larger than {FILE_MAX_BYTES // 1_000_000} MB; cut it down")
        rows = _shape_rows(path, value) if path.suffix.casefold() == ".shp" else (
            _csv_rows(path, value)
        )  # fmt: skip
    except FileNotFoundError:
        raise TrialError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise TrialError(f"{path}: cannot be read ({error.strerror or error})") from None
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    table = table[np.isfinite(table).all(axis=1)]
    if not (len(table) and (np.abs(table[:, 0]) <= 90.0).all()):
        raise TrialError(
            f"{path}: no points with {value} and coordinates in degrees; export it again"
        )
    return table[:, 0], table[:, 1], table[:, 2]


def _csv_rows(path: Path, value: str) -> list[tuple[float, float, float]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise TrialError(f"{path}: this is not text in UTF-8; save it as CSV in UTF-8") from None
    first = text.partition("\n")[0]
    reader = csv.reader(StringIO(text), delimiter=max(",;\t", key=first.count))
    names = [name.strip().casefold() for name in next(reader, [])]
    places = [
        next((names.index(name) for name in wanted if name in names), None)
        for wanted in (LATITUDE, LONGITUDE, (value.casefold(),))
    ]
    if None in places:
        raise TrialError(
            f"{path}: needs columns lat, lon and {value}; it has {', '.join(names)[:120]}"
        )
    rows = []
    for number, row in enumerate(reader, 2):
        if not row:
            continue
        try:
            lat, lon, own = (row[at].strip() for at in places if at is not None)
            rows.append((float(lat), float(lon), float(own) if own else np.nan))
        except (ValueError, IndexError):
            raise TrialError(f"{path}: line {number}: no numbers; correct it") from None
    return rows


def _shape_rows(path: Path, value: str) -> list[tuple[float, float, float]]:
    import shapefile
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    try:
        with shapefile.Reader(str(path)) as reader:
            names = [one[0] for one in reader.fields[1:]]
            if value not in names:
                raise TrialError(f"{path}: has no column {value}; it has {', '.join(names)[:120]}")
            if reader.shapeTypeName not in ("POINT", "POINTZ", "POINTM"):
                raise TrialError(f"{path}: holds no points; export the harvest as points")
            points = [
                (*one.shape.points[0], one.record[value]) for one in reader.iterShapeRecords()
            ]
        projection = path.with_suffix(".prj")
        crs = CRS.from_wkt(projection.read_text()) if projection.exists() else CRS.from_epsg(4326)
    except (shapefile.ShapefileException, CRSError, ValueError, IndexError) as error:
        raise TrialError(f"{path}: cannot be read as a shapefile ({str(error)[:80]})") from None
    degrees = Transformer.from_crs(crs, 4326, always_xy=True)
    x, y = (np.array([one[at] for one in points], dtype=np.float64) for at in (0, 1))
    longitude, latitude = degrees.transform(x, y)
    values = [np.nan if one[2] is None else float(one[2]) for one in points]
    return list(zip(latitude.tolist(), longitude.tolist(), values, strict=True))


def _row(one: Achieved, half: float) -> dict[str, Any]:
    error = one.error_l_ha
    return {
        "plot": one.plot.number,
        "block": one.plot.block,
        "rate_l_ha": one.plot.rate_l_ha,
        "achieved_l_ha": one.rate_l_ha,
        "achieved_half_95_l_ha": half,
        "error_l_ha": error,
        "error_percent": None
        if not one.plot.rate_l_ha > 0.0
        else 100.0 * error / one.plot.rate_l_ha,
        "sd_l_ha": one.sd_l_ha,
        "covered_percent": one.covered_percent,
        "inner_m2": float(one.plot.inner.area),
        "failed": list(one.reasons),
    }


def _line(one: Achieved, half: float) -> str:
    plot = one.plot
    sd = "" if one.sd_l_ha is None else f", sd {one.sd_l_ha:.2f}"
    text = (
        f"plot {plot.number} (block {plot.block}, {plot.rate_l_ha:g} L/ha): "
        f"{one.rate_l_ha:.2f} ± {half:.2f} L/ha ({one.error_l_ha:+.2f}{sd}), "
        f"{one.covered_percent:.0f} % sprayed"
    )
    return f"{text}; FAILED: {', '.join(one.reasons)}" if one.reasons else text


def _write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    text = csv_of([{**row, "failed": "; ".join(row["failed"])} for row in rows])
    with writing(f"{path}"):
        write_atomically(path, text.encode())


# What the program's own command line takes in: one command of the kind that Typer makes.
trial = typer.main.get_command(app)

"""`vrspray map new`: maps for trials, as points in P2's text format or as plots in any other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer

from companion.cli.answer import AsJson, answer
from missions.maps.cli.grid import Force, check_new, grid, parse_numbers, parse_place
from missions.maps.convert.make_map import Plots, Points, make_plots, make_points
from missions.maps.layer import digest, read_bytes
from missions.maps.text.text_points import write_text_map

__all__ = ["NEW_EXAMPLE", "grid", "new"]

Wanted = TypeVar("Wanted", Points, Plots)

NEW_EXAMPLE = (
    "Examples: vrspray map new --out field.txt --points 2302 --east-m 480.3 --north-m 595.3 "
    "--origin 37.85,-4.8,120 --rate-min 15 --rate-max 45 | "
    "vrspray map new --out plots.geojson --rows 4 --columns 10 --plot-length-m 12 "
    "--plot-width-m 6 --rates 15,18,21,24,27 --seed 1 --origin 35.996,114.543"
)

_OF_POINTS = ("points", "east_m", "north_m", "rate_min", "rate_max")
_OF_PLOTS = ("rows", "columns", "plot_length_m", "plot_width_m", "rates")

_Count = Annotated[int | None, typer.Option("--points", metavar="NP", help="Text: how many.")]
_EastRange = Annotated[float | None, typer.Option(metavar="M", help="Text: from west to east.")]
_NorthRange = Annotated[float | None, typer.Option(metavar="M", help="Text: from south to north.")]
_EastMin = Annotated[float, typer.Option(metavar="M", help="Text: of the origin, the west edge.")]
_NorthMin = Annotated[float, typer.Option(metavar="M", help="Text: of the origin, the south edge.")]
_RateMin = Annotated[float | None, typer.Option(metavar="L_MIN", help="Text: the least rate.")]
_RateMax = Annotated[float | None, typer.Option(metavar="L_MIN", help="Text: the largest rate.")]
_Rows = Annotated[int | None, typer.Option(metavar="N", help="Plots: how many rows.")]
_Columns = Annotated[int | None, typer.Option(metavar="N", help="Plots: how many in a row.")]
_Length = Annotated[float | None, typer.Option(metavar="M", help="Plots: size along the row.")]
_Width = Annotated[float | None, typer.Option(metavar="M", help="Plots: size across the row.")]
_Gap = Annotated[float, typer.Option(metavar="M", help="Plots: alley between them.")]
_Angle = Annotated[
    float, typer.Option(metavar="DEG", help="Plots: direction of the rows, clockwise from north.")
]
_Rates = Annotated[
    str | None, typer.Option(metavar="L_HA,…", help="Plots: rates in turn along the rows.")
]
_Seed = Annotated[
    int | None, typer.Option(metavar="N", help="Another field; plots: rates in random order.")
]
_Out = Annotated[
    Path, typer.Option("--out", metavar="FILE", help=".txt for points, else the format of plots.")
]
_Origin = Annotated[
    str, typer.Option(metavar="LAT,LON[,ALT]", help="Degrees, metres; south-west corner.")
]


def new(
    out: _Out,
    origin: _Origin,
    points: _Count = None,
    east_m: _EastRange = None,
    north_m: _NorthRange = None,
    east_min_m: _EastMin = 0.0,
    north_min_m: _NorthMin = 0.0,
    rate_min: _RateMin = None,
    rate_max: _RateMax = None,
    rows: _Rows = None,
    columns: _Columns = None,
    plot_length_m: _Length = None,
    plot_width_m: _Width = None,
    gap_m: _Gap = 0.0,
    angle_deg: _Angle = 90.0,
    rates: _Rates = None,
    seed: _Seed = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Make a map for a trial: points in L/min (.txt), or plots in L/ha in any other format."""
    given = {
        "points": points,
        "east_m": east_m,
        "north_m": north_m,
        "rate_min": rate_min,
        "rate_max": rate_max,
        "rows": rows,
        "columns": columns,
        "plot_length_m": plot_length_m,
        "plot_width_m": plot_width_m,
        "rates": rates,
    }
    text = out.suffix.casefold() == ".txt"
    _check_given(given, text=text)
    place = parse_place(origin, "--origin")
    check_new(out, force=force)
    if text:
        start_m = (east_min_m, north_min_m)
        result = _new_points(out, given, origin=place, start_m=start_m, seed=seed or 0)
    else:
        wanted = _asked(
            Plots,
            origin=place[:2],
            rows=rows,
            columns=columns,
            length_m=plot_length_m,
            width_m=plot_width_m,
            rates_l_ha=parse_numbers(str(rates), "--rates"),
            gap_m=gap_m,
            angle_deg=angle_deg,
            seed=seed,
        )
        result = _new_plots(out, wanted, force=force)
    amount = f"{result['points']} points" if text else f"{result['zones']} plots"
    least, most = result["rates"][0], result["rates"][-1]
    line = f"{out}: {amount}, {result['area_ha']:.4g} ha, {least:g} to {most:g} {result['unit']}"
    answer(result, [line], as_json=as_json)


def _check_given(given: dict[str, Any], *, text: bool) -> None:
    """Ask for what is missing, and refuse what belongs to the other kind of map."""
    needed, foreign = (_OF_POINTS, _OF_PLOTS) if text else (_OF_PLOTS, _OF_POINTS)
    kind = "a text map (.txt)" if text else "a map of plots"
    wrong = [_option(name) for name in foreign if given[name] is not None]
    if wrong:
        raise typer.BadParameter(f"{kind} has no {', '.join(wrong)}")
    missing = [_option(name) for name in needed if given[name] is None]
    if missing:
        raise typer.BadParameter(f"{kind} needs {', '.join(missing)}")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _new_points(
    out: Path,
    given: dict[str, Any],
    *,
    origin: tuple[float, float, float],
    start_m: tuple[float, float],
    seed: int,
) -> dict[str, Any]:
    wanted = _asked(
        Points,
        origin=origin,
        count=given["points"],
        east_range_m=given["east_m"],
        north_range_m=given["north_m"],
        east_min_m=start_m[0],
        north_min_m=start_m[1],
        rate_min_l_min=given["rate_min"],
        rate_max_l_min=given["rate_max"],
        seed=seed,
    )
    made = make_points(wanted)
    write_text_map(made, out)
    return {
        "file": str(out),
        "kind": "text",
        "points": made.count,
        "area_ha": wanted.east_range_m * wanted.north_range_m / 10_000.0,
        "rates": np.unique(made.rate_l_min).tolist(),
        "unit": "L/min",
        "sha256": digest([read_bytes(out)]),
    }


def _new_plots(out: Path, wanted: Plots, *, force: bool) -> dict[str, Any]:
    from missions.maps.convert.formats import write_map

    made = make_plots(wanted, out, map_format=out.suffix.lstrip("."))
    write_map(made, out, force=force)
    return {
        "file": str(out),
        "kind": "plots",
        "zones": len(made.zones),
        "area_ha": len(made.zones) * wanted.length_m * wanted.width_m / 10_000.0,
        "rates": list(made.rates_l_ha),
        "unit": "L/ha",
    }


def _asked(kind: type[Wanted], **fields: Any) -> Wanted:
    """Return what is asked for, checked."""
    try:
        return kind(**fields)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error

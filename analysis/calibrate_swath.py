"""`vrspray calibrate swath`: from cards or a string across the track to the effective swath."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from analysis.write_back import Write, check_asked, tell_measured
from companion.cli.answer import AsJson, answer, note
from companion.wording import counted

if TYPE_CHECKING:
    from analysis.swath import Found, Pattern

# Of the mean of the whole overlapped pattern: the limit that USDA's and NAAA's clinics go by.
CV_MAX = 25.0
FAR_M, MOST = 200.0, 1e9
# Fewer than these passes say little of the next one (ASABE S386 asks for three).
PASSES_MIN = 3
# Swaths are written in steps of so much, downwards.
WRITTEN_M = 0.1
# A boom that sits so far aside leaves passes to and fro too near and too far.
ASIDE_SHARE = 0.02


def swath(
    csv: Annotated[
        Path,
        typer.Argument(
            metavar="CSV",
            help="Columns right_m (of the track, seen in the direction of flight) and deposit (any "
            "unit); pass and wind_right_m_s (+ blows towards the right) may be added.",
        ),
    ],
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Configuration that --write changes.")
    ] = None,
    cv_max: Annotated[
        float,
        typer.Option(
            "--cv-max", metavar="PCT", min=1.0, max=100.0, help="Largest coefficient of variation."
        ),
    ] = CV_MAX,
    one_way: Annotated[
        bool, typer.Option("--one-way", help="All passes are flown in one direction.")
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Picture: pattern, overlapped pattern, CV curve."),
    ] = None,
    is_write: Write = False,
    as_json: AsJson = False,
) -> None:
    """Find the effective swath from the deposit across the track.

    It is the widest lane spacing at which passes side by side vary by no more than 25 % (CV). Lay
    cards or a string at right angles to the track and fly over them three times or more.

    Exit 0: found; 1: no spacing is even enough; 2: the file or an option cannot be used.

    Example: vrspray calibrate swath cards.csv --config config.toml --plot swath.png
    """
    from analysis.swath import evaluate

    check_asked(config, is_write=is_write)
    found = evaluate(read_passes(csv), cv_max)
    result = result_of(found, config, one_way=one_way)
    if plot is not None:
        from analysis.calibrate_plots import plot_swath

        plot_swath(found, plot, one_way=one_way)
        result["plot"] = str(plot)
    if result["effective_swath_m"] is None:
        text = (
            f"{csv}: no lane spacing has a CV of {cv_max:g} % or less; look for blocked nozzles, "
            "and sample closer together"
        )
        answer({**result, "error": text}, (), as_json=as_json)
        note(f"error: {text}")
        raise typer.Exit(1)
    tell_measured(config, result, _lines(result), is_write=is_write, as_json=as_json)


def read_passes(path: Path) -> tuple[Pattern, ...]:
    """Return the passes of a CSV file, in its order."""
    from analysis.csv_rows import TableError, read_rows
    from analysis.swath import Pattern

    samples: dict[str, list[tuple[float, float]]] = {}
    winds: dict[str, float | None] = {}
    for row in read_rows(path, ("right_m", "deposit")):
        name = row.text("pass") or "1"
        at = row.needed("right_m", low=-FAR_M, high=FAR_M)
        samples.setdefault(name, []).append((at, row.needed("deposit", low=0.0, high=MOST)))
        wind = row.number("wind_right_m_s", low=-30.0, high=30.0)
        if winds.setdefault(name, wind) != wind and wind is not None:
            if winds[name] is not None:
                raise row.error(f"pass {name} has two winds; write one for the whole pass")
            winds[name] = wind
    found = []
    for name, rows in samples.items():
        rows.sort()
        places = [at for at, _ in rows]
        if len(set(places)) < len(places):
            raise TableError(
                f"{path}: pass {name} has two samples at one place; write their mean, or number "
                "the passes in a column pass"
            )
        if len(rows) < 3 or not any(deposit for _, deposit in rows):
            raise TableError(
                f"{path}: pass {name} needs three samples, and some deposit in one; take it out"
            )
        found.append(
            Pattern(
                name=name, right_m=tuple(places), deposit=tuple(deposit for _, deposit in rows),
                wind_right_m_s=winds[name],
            )
        )  # fmt: skip
    return tuple(found)


def result_of(found: Found, config: Path | None, *, one_way: bool) -> dict[str, Any]:
    """Return what was found as JSON has it."""
    chosen = found.swath_m["one_way" if one_way else "to_and_fro"]
    written = None if chosen is None else math.floor(chosen / WRITTEN_M + 1e-6) * WRITTEN_M
    aside = found.displacement
    return {
        "effective_swath_m": written,
        "flown": "one-way" if one_way else "to-and-fro",
        "cv_max_percent": found.cv_max,
        "one_way": {"swath_m": found.swath_m["one_way"]},
        "to_and_fro": {"swath_m": found.swath_m["to_and_fro"]},
        "passes": [
            {
                "name": one.name, "samples": len(one.right_m), "centre_m": one.centre_m,
                "wind_right_m_s": one.wind_right_m_s, "swath_m": own, "deposit": one.total,
            }
            for one, own in zip(found.passes, found.by_pass_m, strict=True)
        ],
        "displacement": {
            "still_m": aside.still_m,
            "fall_s": None if aside.fall_s is None else asdict(aside.fall_s),
            "scatter_m": aside.scatter_m,
        },
        "pattern": {"right_m": list(found.mean.right_m), "deposit": list(found.mean.deposit)},
        "cv_curve": [
            {"spacing_m": round(float(at), 3), "one_way_percent": one, "to_and_fro_percent": two}
            for at, one, two in zip(
                found.spacing_m, found.cv["one_way"].tolist(), found.cv["to_and_fro"].tolist(),
                strict=True,
            )
        ],
        "warnings": _warnings(found, chosen, config, one_way=one_way),
        "toml": "" if written is None else _toml(found, written, config),
    }  # fmt: skip


def _warnings(
    found: Found, chosen: float | None, config: Path | None, *, one_way: bool
) -> list[str]:
    said = []
    if len(found.passes) < PASSES_MIN:
        said.append(f"{counted(len(found.passes), 'pass')}: fly {PASSES_MIN} or more, they differ")
    cut = [one.name for one in found.passes if one.is_cut_off]
    if cut:
        said.append(
            f"pass {', '.join(cut)}: the line of samples ends before the deposit does; make it "
            "longer, the swath is not known"
        )
    if chosen is None:
        return said
    aside = found.displacement.still_m
    if abs(aside) > ASIDE_SHARE * chosen:
        side = "right" if aside > 0.0 else "left"
        cause = "" if found.displacement.fall_s else " (wind_right_m_s would tell whether by wind)"
        said.append(f"the deposit lies {abs(aside):.2f} m {side} of the track{cause}")
    cv = found.cv["one_way" if one_way else "to_and_fro"]
    above = found.spacing_m[(found.spacing_m < chosen) & (cv > found.cv_max)]
    if len(above):
        said.append(
            f"narrower spacings of {above[0]:.2f} to {above[-1]:.2f} m are less even than "
            f"{found.cv_max:g} %: look at the curve (--plot)"
        )
    fall = found.displacement.fall_s
    if fall is not None and fall.low <= 0.0:
        said.append("the passes do not show that wind moves the deposit: fall_s is left out")
    if config is not None:
        from companion.config import load

        loaded = load(config)
        if abs(loaded.boom_table.width_m - chosen) > 0.1 * chosen:
            said.append(
                f"boom.width_m was {loaded.boom_table.width_m:g}: run `vrspray config check` "
                "afterwards, the strips of the valves have to adjoin"
            )
    return said


def _toml(found: Found, swath_m: float, config: Path | None) -> str:
    lines = ["[boom]", f"width_m = {swath_m:.1f}"]
    has_mission = True
    if config is not None:
        from companion.config import load

        has_mission = load(config).mission is not None
    if has_mission:
        lines += ["[mission]", f"swath_width_m = {swath_m:.1f}"]
    fall = found.displacement.fall_s
    if fall is not None and fall.low > 0.0:
        lines += ["[drift]", f"fall_s = {fall.value:.3f}"]
    return "\n".join(lines)


def _lines(result: dict[str, Any]) -> list[str]:
    def metres(value: float | None) -> str:
        return "none" if value is None else f"{value:.2f} m"

    aside = result["displacement"]
    lines = [
        f"{len(result['passes'])} passes; widest lane spacing with a CV of at most "
        f"{result['cv_max_percent']:g} %:",
        f"  to and fro  {metres(result['to_and_fro']['swath_m'])}",
        f"  one way     {metres(result['one_way']['swath_m'])}",
        "  each pass   " + ", ".join(metres(one["swath_m"]) for one in result["passes"]),
        f"deposit's centre without wind: {aside['still_m']:+.2f} m right of the track",
    ]
    fall = aside["fall_s"]
    if fall is not None:
        lines.append(
            f"by wind: {fall['value']:+.2f} m for each m/s "
            f"({fall['low']:+.2f} to {fall['high']:+.2f}, 95 %)"
        )
    return [*lines, "", f"# flown {result['flown']}", *result["toml"].splitlines()]

"""`vrspray plan`: from a field and its prescription to mission files."""

from __future__ import annotations

import gc
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import Annotated, Any, Literal

import typer

from companion.cli.answer import AsJson, Tell, answer, new_app, note, progress
from companion.errors import MapError
from companion.wording import counted
from missions.files.fence import Fences, Ground, fence_warnings
from missions.files.write import (
    check_suffix,
    format_warnings,
    lines_beside,
    names_of,
    refuse_existing,
    remove_older,
    stale_warnings,
    write_fleet,
)
from missions.maps.cli.new import parse_mark
from missions.maps.cli.options import Reading, reading_options
from missions.maps.model import check_folder
from missions.mix import mix_lines, mix_of, with_tank
from missions.picture import check_picture, draw_plan
from missions.pilot_sheet import (
    check_sheet,
    field_name,
    ground_text,
    parse_start,
    product_of,
    write_sheet,
)
from missions.plan import LEAVE_PERCENT, Plan
from missions.planner import plan_mission
from missions.prices import Price, no_choices, overlap_warnings, prices, twice_hint
from missions.reading import Asked, Task, assumed, read_task
from missions.reading_fleet import BreakAsked
from missions.reading_ground import Autopilot, GroundAsked, label_warnings, parse_run_in, parse_wind
from missions.reading_outline import CORRIDOR_MAX_M, RADIUS_MAX_M
from missions.remaining import UntreatedRates
from missions.searching import Watch, watched
from missions.sheet import sheet, sortie_lines
from missions.treated import thirsty_warnings, treated_by, treated_lines

# Attempted moves of the search: about one second, ten, and a minute on an old laptop.
MOVES = {"quick": 40_000, "good": 300_000, "best": 2_000_000}

# After so many new objects rings of them are looked for: a tenth of the time of a plan otherwise.
OBJECTS_TO_LOOK = 100_000
# Below this no bar is worth looking at.
BAR_AFTER_S = 2.0

app = new_app()


@app.command(
    epilog="Example: vrspray plan examples/anyang/boundary.geojson "
    "--config examples/anyang/config.toml --out field.plan"
)
@reading_options
def plan(
    field: Annotated[
        Path, typer.Argument(metavar="FIELD", help="Field outline, in any map format.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help=".plan, .waypoints, .geojson or .kml.")
    ],
    reading: Reading,
    prescription: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Prescription map, to plan the volume.")
    ] = None,
    obstacle: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Obstacles to fly around; repeatable.")
    ] = None,
    obstacle_radius_m: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Radius of point obstacles without radius_m.",
            min=0.1,
            max=RADIUS_MAX_M,
        ),
    ] = None,
    corridor_m: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Full width of line obstacles without corridor_m.",
            min=0.1,
            max=CORRIDOR_MAX_M,
        ),
    ] = None,
    holes: Annotated[
        Literal["around", "over"],
        typer.Option(help="Keep off the field's holes, as from obstacles, or not."),
    ] = "around",
    no_spray: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Ground not to spray; repeatable.")
    ] = None,
    no_spray_buffer_m: Annotated[
        float,
        typer.Option(metavar="M", help="Distance to keep from that ground.", min=0.0, max=1000.0),
    ] = 0.0,
    depot: Annotated[
        list[str] | None, typer.Option(metavar="LAT,LON", help="Refill place; repeatable.")
    ] = None,
    swath_m: Annotated[float | None, typer.Option(metavar="M", help="Spacing of passes.")] = None,
    speed_m_s: Annotated[
        float | None, typer.Option(metavar="V", help="Speed in the passes.")
    ] = None,
    speed_max_m_s: Annotated[
        float | None,
        typer.Option(metavar="V", help="Speed up to this where rates are too low for the valves."),
    ] = None,
    border_m: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Distance of passes from every border; default: what keeps outer valves open.",
            min=0.0,
            max=50.0,
        ),
    ] = None,
    ends_over: Annotated[
        bool,
        typer.Option(
            "--ends-over", help="Small fields: boom may overhang the border, valves closed."
        ),
    ] = False,
    angle_deg: Annotated[
        float | None, typer.Option(metavar="DEG", help="Course of the passes; default: the best.")
    ] = None,
    rate_l_ha: Annotated[
        float | None, typer.Option(metavar="R", help="One rate in L/ha instead of a map.")
    ] = None,
    tank_l: Annotated[
        float | None, typer.Option(metavar="L", help="Volume of a full tank.")
    ] = None,
    effort: Annotated[
        Literal["quick", "good", "best"], typer.Option(help="How long to search for short ferries.")
    ] = "quick",
    sprayer: Annotated[
        bool, typer.Option("--sprayer", help="Add DO_SPRAYER at every line; ArduPilot only.")
    ] = False,
    terrain: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Elevation model to follow: .tif or .hgt.")
    ] = None,
    autopilot: Annotated[
        Autopilot | None,
        typer.Option(help="Autopilot that flies the plan; default: mission.autopilot."),
    ] = None,
    wind: Annotated[
        str | None,
        typer.Option(metavar="SPEED,FROM", help="Wind for no-spray buffers: m/s, degrees."),
    ] = None,
    run_in_m: Annotated[
        str | None,
        typer.Option(metavar="M|auto", help="Run-in and run-out of passes at full speed."),
    ] = None,
    png: Annotated[
        Path | None, typer.Option("--png", metavar="FILE", help="Picture: .png, .svg or .pdf.")
    ] = None,
    pilot_sheet: Annotated[
        Path | None,
        typer.Option("--sheet", metavar="FILE", help="Tank filling sheet to print: .html or .txt."),
    ] = None,
    first: Annotated[
        str | None, typer.Option("--start", metavar="HH:MM", help="First take-off, for --sheet.")
    ] = None,
    ferry_height_m: Annotated[
        float | None, typer.Option(metavar="M", help="Height of ferries and long transits.")
    ] = None,
    leave_max: Annotated[
        float,
        typer.Option(
            metavar="PCT",
            help="Share of the field to leave where it saves time.",
            min=0.0,
            max=50.0,
        ),
    ] = LEAVE_PERCENT,
    overlap_max: Annotated[
        float | None,
        typer.Option(
            metavar="PCT", help="Largest share of the volume to spray twice.", min=0.0, max=100.0
        ),
    ] = None,
    choices_too: Annotated[
        bool,
        typer.Option(
            "--choices", help="Show what --stripes, --leave-max and --overlap-max would change."
        ),
    ] = False,
    stripes: Annotated[
        bool,
        typer.Option("--stripes", help="Sorties may be stripes, not blocks, to save time."),
    ] = False,
    aircraft: Annotated[
        int | None,
        typer.Option(metavar="N", help="Number of aircraft that share the field.", min=1, max=20),
    ] = None,
    done: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Treated ground; plan only the rest.")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Plan (.geojson) to continue.")
    ] = None,
    stop: Annotated[
        str | None, typer.Option("--from", metavar="LAT,LON", help="Place where spraying stopped.")
    ] = None,
    sortie: Annotated[
        int | None, typer.Option(metavar="N", help="Sortie in which spraying stopped.", min=1)
    ] = None,
    in_tank_l: Annotated[
        float,
        typer.Option(metavar="L", help="Mix already in the tank before the first sortie.", min=0.0),
    ] = 0.0,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a plan of this name, with all its files.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Plan the passes over a field, sortie by sortie, and write the mission.

    A .plan or .waypoints file holds one sortie; the second and later ones are numbered beside it.
    "Treated" is what the flight leaves treated: valves stay closed where the aircraft is too slow
    or turns, along the border and over treated ground. "Covered" is what the passes reach.
    """
    start = perf_counter()
    _check_outputs(out, png, pilot_sheet, first, force=force)
    if rate_l_ha is not None and prescription is not None:
        raise typer.BadParameter("--rate-l-ha and --prescription exclude each other")
    asked = Asked(
        field=field,
        answers=reading.answers,
        crs=reading.crs,
        prescription=prescription or _own_rates(field, rate_l_ha, reading),
        obstacles=tuple(obstacle or ()),
        no_spray=tuple(no_spray or ()),
        obstacle_radius_m=obstacle_radius_m,
        corridor_m=corridor_m,
        ground=GroundAsked(
            terrain=terrain,
            autopilot=autopilot,
            wind=parse_wind(wind),
            no_spray_buffer_m=no_spray_buffer_m,
            run_in=parse_run_in(run_in_m),
        ),
        depots=tuple(parse_mark(text, "--depot") for text in depot or ()),
        rate_l_ha=rate_l_ha,
        border_m=border_m,
        over_holes=holes == "over",
        ends_over=ends_over,
        with_sprayer=sprayer,
        pause=BreakAsked(
            done=done,
            resume=resume,
            stop=None if stop is None else parse_mark(stop, "--from"),
            sortie=sortie,
        ),
    )
    changes: dict[str, float | int | None] = {
        "swath_width_m": swath_m,
        "speed_m_s": speed_m_s,
        "speed_max_m_s": speed_max_m_s,
        "angle_deg": angle_deg,
        "tank_l": tank_l,
        "moves": MOVES[effort],
        "aircraft": aircraft,
        "leave_max_percent": leave_max,
        "overlap_max_percent": overlap_max,
        "ferry_height_m": ferry_height_m,
        "stripes": stripes,
    }
    if sprayer and ends_over:
        raise typer.BadParameter("--ends-over needs valves that close one by one, not --sprayer")
    is_fenced = out.suffix.casefold() == ".plan"
    with _seldom_collected():
        task = read_task(asked, reading.config, changes)
        with progress(after_s=BAR_AFTER_S) as tell, _stoppable(tell) as watch:
            fences = Fences(Ground(field=task.field, settings=task.settings))
            planned = plan_mission(
                task.field, task.settings, task.rates, depots=task.depots, left=task.left,
                around=task.around, with_sprayer=sprayer, fences=fences if is_fenced else None,
            )  # fmt: skip
    is_rest = task.left is not None or isinstance(task.rates, UntreatedRates)
    by_label = label_warnings(
        reading.config,
        [planned.airborne_s(sortie) for sortie in planned.sorties],
        datetime.now(tz=UTC).timestamp(),
    )
    planned = replace(
        planned,
        wind=task.wind,
        treated=None if is_rest else treated_by(planned, task.rates),
        settings=with_tank(planned.settings, in_tank_l),
    )
    planned = replace(
        planned,
        warnings=(
            *task.said,
            *by_label,
            *planned.warnings,
            *thirsty_warnings(planned),
        ),
    )
    took_s = perf_counter() - start
    choices: list[tuple[Price, str]] = []
    asks = choices_too or overlap_max is not None or leave_max > LEAVE_PERCENT
    if asks and not is_rest and not watch.stopped:
        choices = _priced(planned, task)
    none = [no_choices(planned)] if choices_too and not is_rest and not watch.stopped else []
    goes_on = resume is not None or done is not None
    mix = mix_of(reading.config, planned, task.rates, goes_on=goes_on)
    lines_before = lines_beside(out)
    with _undisturbed():
        files, marks = write_fleet(planned, out, with_sprayer=sprayer, fences=fences)
    removed = remove_older(out, [*files, *marks])
    stale = stale_warnings(out, lines_before)
    title = field_name(reading.config) or field.stem
    if png is not None:
        draw_plan(planned, png, title=title)
    if is_fenced:
        planned = replace(planned, warnings=(*planned.warnings, *fence_warnings(planned, fences)))
    warnings = planned.warnings
    once = isinstance(task.rates, UntreatedRates)
    result = sheet(planned, with_sprayer=sprayer, once=once) | {
        "planning_s": took_s,
        "stopped": watch.stopped,
        "files": [str(path) for path in files],
        "lines_file": str(marks[0]) if marks else None,
        "lines_files": [str(path) for path in marks],
        "prices": [asdict(price) for price, _ in choices],
        "assumed": assumed(task, asked, reading.config, changes),
        "removed": [str(path) for path in removed],
        "mix": mix,
    }
    if pilot_sheet is not None:
        write_sheet(
            planned, result, pilot_sheet, title=title, product=product_of(reading.config),
            start_min=parse_start(first), picture=png,
        )  # fmt: skip
    warnings = (
        *warnings,
        *overlap_warnings(planned, result["overlap_litres_percent"], is_stopped=watch.stopped),
        *format_warnings(planned, out),
        *stale,
    )
    result["warnings"] = list(warnings)
    said = _choices(planned, result, [text for _, text in choices] or none, asked=asks or sprayer)
    answer(
        result, [*_lines(planned, result, files, task), *(f"choice    {text}" for text in said)],
        as_json=as_json,
    )  # fmt: skip
    own = f"{field} itself: it is a prescription too" if asked.prescription == field else ""
    told = {
        "assumed, not given: ": ", ".join(result["assumed"].values()),
        "rates of ": "" if prescription is not None else own,
        "removed from the earlier plan: ": names_of(removed) if removed else "",
        "note: ": _FLOWN_ONCE if once else "",
        **{f"warning: {warning}": " " for warning in warnings},
        "stopped after ": f"{took_s:.0f} s; wrote the best plan so far" if watch.stopped else "",
    }
    for head, rest in told.items():
        if rest:
            note(f"{head}{rest}".rstrip())


# What ground under two passes is, where valves do not close over treated ground and where they do.
_TWICE = ("twice", "under two passes")
_FLOWN_ONCE = (
    "fly it with `vrspray run --continue`: its guard closes the valves on treated ground and on "
    "what is covered twice, and the litres count neither"
)


@contextmanager
def _stoppable(tell: Tell) -> Iterator[Watch]:
    """Have Ctrl-C end the search, as soon as a plan comes of it; a second one ends the command."""
    watch = Watch(tell=tell)

    def stop(_signal: int, _frame: FrameType | None) -> None:
        if watch.stopped or not watch.has_lines:
            raise KeyboardInterrupt
        watch.stopped = True

    before = signal.signal(signal.SIGINT, stop)
    try:
        with watched(watch):
            yield watch
    finally:
        signal.signal(signal.SIGINT, before)


def _priced(planned: Plan, task: Task) -> list[tuple[Price, str]]:
    """Return the other choices; Ctrl-C leaves out those that are not priced yet."""
    found: list[tuple[Price, str]] = []
    with suppress(KeyboardInterrupt), progress(after_s=BAR_AFTER_S) as tell:
        with watched(Watch(tell=tell)):
            found.extend(prices(planned, task.rates, depots=task.depots, around=task.around))
        return found
    note("stopped: not all choices are shown")
    return found


@contextmanager
def _seldom_collected() -> Iterator[None]:
    """Look for rings of objects seldom: planning makes many small objects and next to no rings."""
    before = gc.get_threshold()
    gc.set_threshold(OBJECTS_TO_LOOK, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Have Ctrl-C wait: some sorties of this plan beside some of an earlier one would be flown."""
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def _own_rates(field: Path, rate_l_ha: float | None, reading: Reading) -> Path | None:
    """Return the field's file where it is a prescription too and nothing else gives rates."""
    named = reading.config is not None and reading.config.prescription is not None
    if rate_l_ha is not None or named:
        return None
    try:
        found = reading.read(field)
    except MapError:  # an outline, or rates that it does not explain: as without them
        return None
    return field if found.rates_l_ha else None


def _check_outputs(
    out: Path, png: Path | None, pilot_sheet: Path | None, first: str | None, *, force: bool
) -> None:
    """Refuse files that cannot be written, before any work."""
    check_suffix(out)
    if png is not None:
        check_picture(png)
    if pilot_sheet is not None:
        check_sheet(pilot_sheet)
    elif first is not None:
        raise typer.BadParameter("--start is for --sheet, whose times it sets")
    parse_start(first)
    for path in (out, png, pilot_sheet):
        if path is not None:
            check_folder(path)
    if not force:
        refuse_existing(out, [path for path in (png, pilot_sheet) if path is not None])


def _choices(planned: Plan, result: dict[str, Any], prices: list[str], *, asked: bool) -> list[str]:
    """Return the other choices with their prices; where none was asked for, a hint at them."""
    return prices if asked else list(twice_hint(planned, result["overlap_litres_percent"]))


def _once(planned: Plan) -> str:
    """Return that the litres count on valves that close, where they spare any."""
    if not planned.closes:
        return ""
    coverage = planned.coverage
    more_l = coverage.overlap_percent / max(coverage.percent, 1.0) * planned.volume_l
    return f", treated ground not again, as the litres count; without it up to {more_l:.1f} L more"


def _lines(planned: Plan, result: dict[str, Any], files: list[Path], task: Task) -> list[str]:
    """Return the plan in words."""
    coverage = planned.coverage
    where = ", ".join(f"{lat:.6f} {lon:.6f}" for lat, lon in result["depots"])
    least_m = result["least_idle_m"]
    idle = f" (together at least {least_m / 1000:.2f} km, in any order)" if least_m >= 50.0 else ""
    lines = [
        f"{names_of(files)}: {counted(len(planned.sorties), 'sortie')}, {planned.volume_l:.1f} L, "
        f"{planned.times}",
        *treated_lines(planned, task.rates, has_runs=task.around.run_in is not None),
        f"covered   {coverage.percent:.2f} % of {ground_text(result)}, "
        f"{coverage.overlap_percent:.2f} % {_TWICE[planned.closes]}, "
        f"{coverage.outside_m2:.1f} m2 outside",
        f"passes    {len(planned.lines)} at {planned.angle_deg:.1f} deg, "
        f"{result['spray_m'] / 1000:.2f} km; transit {result['transit_m'] / 1000:.2f} km, "
        f"ferry {result['ferry_m'] / 1000:.2f} km{idle}",
        f"depot     {where}{' (suggested)' if planned.suggested_depot else ''}",
    ]
    holes = planned.field.holes
    if holes.kept_m and holes.count:
        lines.append(
            f"holes     {holes.count}, the aircraft stays {holes.kept_m:g} m away "
            f"(mission.obstacle_buffer_m): {holes.bare_m2:.0f} m2 beside them stay bare; --holes "
            "over if they may be flown over"
        )
    if result["lines_file"] is not None:
        names = ", ".join(result["lines_files"])
        name = "it" if len(result["lines_files"]) == 1 else "each aircraft's own"
        lines.append(
            f"lines     {names}: name {name} as mission.lines in the configuration, and only "
            f"passes are sprayed{_once(planned)}"
        )
    lines += sortie_lines(planned, result)
    return lines if result["mix"] is None else [*lines, *mix_lines(result["mix"])]

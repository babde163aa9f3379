"""`vrspray calibrate curve`: the flow between weighed duties, by the shape a meter sees."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from analysis.calibrate_valves import (
    HoldLines,
    Keep,
    Measure,
    Record,
    done_at_last,
    failed,
    measuring,
    read_json,
    record_in,
    record_of_piece,
    shape_of,
    write_json,
)
from analysis.calibration.curve import (
    PASSES,
    RATIO_SPREAD_MAX,
    CurveCourseError,
    Weighed,
    curve_course,
    identify_curve,
)
from analysis.calibration.valves import ValveCourseError
from analysis.write_back import Write, written_lines
from companion.cli.answer import AsJson, ConfigFile, Overrides, answer
from companion.errors import ConfigError

if TYPE_CHECKING:
    from analysis.calibration.curve import CurveCourse, SetCurve
    from analysis.calibration.steps import FlowRecord
    from companion.config import Config

FORMAT = "vrspray-curve-1"
Records = dict[tuple[int, ...], list["FlowRecord"]]


def curve(
    config_file: ConfigFile,
    passes: Annotated[
        int, typer.Option(min=2, max=20, help="How often each duty is measured; up, then down.")
    ] = PASSES,
    is_lines: HoldLines = False,
    out: Keep = None,
    record: Record = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture of all sets.")] = None,
    overrides: Overrides = None,
    is_write: Write = False,
    as_json: AsJson = False,
) -> None:
    """Measure how the flow runs between the duties of the bucket test.

    The flow meter tells the shape, the weighed flows stay as they are. With water, disarmed, on the
    ground, while you hold a key. Exit 1: the measurement failed.

    Example: vrspray calibrate curve --config config.toml --plot curve.png --write
    """
    from companion.cli.output_parts import load_with_kept

    config, given = load_with_kept(config_file, tuple(overrides or ()))
    sets = weighed_sets(config, config_file)
    names = [valve.name for valve in config.valve]
    try:
        if record is not None:
            records = read_records(record, names)
        else:
            courses = [
                curve_course(each, config.pwm_limits(), config.lag_model(), passes=passes)
                for each in sets
            ]
            records = _measured_here(config, given, sets, courses, is_lines=is_lines)
            if out is not None:
                write_records(out, names, records)
        found = [identify_curve(records.get(each.valves, ()), each) for each in sets]
    except (CurveCourseError, ValveCourseError) as error:
        raise failed(error, as_json=as_json) from error
    result = as_shape(found, names)
    if plot is not None:
        from analysis.calibrate_plots import plot_set_curves

        plot_set_curves(found, [each["set"] for each in result["sets"]], plot)
    changed = written_lines(config_file, result, is_write=is_write)
    answer(result, [*lines(result), *changed], as_json=as_json)


def weighed_sets(config: Config, path: Path) -> list[Weighed]:
    """Return what was weighed of each set; ConfigError where nothing was."""
    if config.makes_flow:
        raise ConfigError(
            f"{path}: the pump makes the flow and no duty of valves does; measure the pump with "
            "`vrspray calibrate flow`"
        )
    index = {valve.name: number for number, valve in enumerate(config.valve)}
    found = []
    for number, table in enumerate(config.nozzle_set):
        if table.preset is not None:
            raise ConfigError(
                f"{path}: nozzle_set[{number}].preset is a published law and nothing was weighed; "
                "do a bucket test first (`vrspray calibrate flow`)"
            )
        duty, flow_l_min = table.weighed()
        valves = tuple(sorted(index[name] for name in table.valves))
        found.append(Weighed(valves=valves, duty=duty, flow_l_min=flow_l_min))
    return found


def _measured_here(
    config: Config,
    given: tuple[str, ...],
    sets: Sequence[Weighed],
    courses: Sequence[CurveCourse],
    *,
    is_lines: bool,
) -> Records:
    """Do all pieces with the configured outputs and the meter, while a key is held."""
    if config.flow_meter.source != "gpio":
        raise ConfigError(
            'calibrate curve: needs the pulses of a flow meter ([flow_meter] source = "gpio"); '
            "the autopilot's counts are too coarse; without a meter weigh more duties"
        )
    told = course_lines(sets, courses)
    return measured_records(config, courses, measuring(config, given, told, is_lines=is_lines))


def course_lines(sets: Sequence[Weighed], courses: Sequence[CurveCourse]) -> list[str]:
    """Return in words what will be done, and what it takes."""
    pieces = sum(len(list(course.pieces())) for course in courses)
    seconds = sum(course.seconds for course in courses)
    litres = sum(
        course.passes * course.dwell_s / 60.0 * each.curve.flow_for(duty)
        for course, each in zip(courses, sets, strict=True)
        for duty in course.duties
    )
    return [
        f"{sum(len(course.duties) for course in courses)} duties, all valves of a set together: "
        f"{pieces} pieces of up to 30 s, about {seconds / 60.0:.0f} min and {litres:.0f} L of water"
    ]


def measured_records(config: Config, courses: Sequence[CurveCourse], measure: Measure) -> Records:
    """Return the record of every piece; one that was broken off is done again."""
    sets = {each.valves: each for each in config.nozzle_sets()}
    names = [valve.name for valve in config.valve]
    found: Records = {}
    for course in courses:
        pieces = list(course.pieces())
        label = f"set {set_name(course.valves, names)}"
        for number, duties in enumerate(pieces, 1):
            what = f"{label}, piece {number} of {len(pieces)}"
            done = done_at_last(measure, course.task(duties, len(names)), what)
            record = record_of_piece(done, config, sets[course.valves])
            found.setdefault(course.valves, []).append(record)
    return found


def set_name(valves: Sequence[int], names: Sequence[str]) -> str:
    """Return the names of a set's valves.

    >>> set_name((0, 2), ("left", "middle", "right"))
    'left right'
    """
    return " ".join(names[valve] for valve in valves)


def write_records(path: Path, names: Sequence[str], records: Records) -> None:
    """Write what was recorded as JSON; ConfigError where that cannot be."""
    first = next(record for each in records.values() for record in each)
    write_json(
        path,
        {
            "format": FORMAT,
            "valves": list(names),
            "measured_on": datetime.now(UTC).astimezone().date().isoformat(),
            "period_s": first.period_s,
            "lag": asdict(first.lag),
            "pieces": [
                {"set": list(valves), **shape_of(record)}
                for valves, each in records.items()
                for record in each
            ],
        },
    )


def read_records(path: Path, names: Sequence[str]) -> Records:
    """Return what `write_records` wrote; ConfigError where it is of other valves."""
    document = read_json(path, names, FORMAT)
    found: Records = {}
    try:
        for piece in document["pieces"]:
            valves = tuple(int(valve) for valve in piece["set"])
            found.setdefault(valves, []).append(record_in(document, piece))
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"--from {path}: is damaged ({error!r})") from error
    return found


# The answer.


def as_shape(found: Sequence[SetCurve], names: Sequence[str]) -> dict[str, Any]:
    """Return the answer: each set's points, what of them was weighed, TOML."""
    return {
        "sets": [
            {
                "set": set_name(each.valves, names),
                "points": [asdict(point) for point in each.points],
                "left_out": list(each.left_out),
                "scatter_percent": 100.0 * each.scatter,
                "ratio_spread_percent": 100.0 * each.ratio_spread,
            }
            for each in found
        ],
        "volume_l": sum(each.volume_ml for each in found) / 1000.0,
        "toml": "\n".join(toml_lines(found, names)),
    }


def toml_lines(found: Sequence[SetCurve], names: Sequence[str]) -> Iterator[str]:
    """Yield the `[[nozzle_set]]` tables; a weighed figure stands as it was."""
    for each in found:
        yield "[[nozzle_set]]"
        yield f"valves = {json.dumps([names[valve] for valve in each.valves])}"
        yield f"duty = [{', '.join(repr(point.duty) for point in each.points)}]"
        flows = [
            repr(point.flow_l_min if point.is_weighed else round(point.flow_l_min, 4))
            for point in each.points
        ]
        yield f"flow_l_min = [{', '.join(flows)}]"
        yield f"weighed_duty = [{', '.join(repr(duty) for duty in each.weighed_duty)}]"


def lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the answer for a person."""
    for each in result["sets"]:
        yield f"set {each['set']}: a duty repeats to {each['scatter_percent']:.1f} % (1 sd)"
        yield "   duty   L/min   +- 95 %  straight between weighed %"
        for point in each["points"]:
            if point["is_weighed"]:
                yield f"  {point['duty']:.3f}  {point['flow_l_min']:6.3f}   weighed"
                continue
            half = 0.5 * (point["high"] - point["low"])
            off = 100.0 * (point["straight_l_min"] / point["flow_l_min"] - 1.0)
            yield f"  {point['duty']:.3f}  {point['flow_l_min']:6.3f}   {half:6.3f}  {off:+.1f}"
        for duty in each["left_out"]:
            yield f"duty {duty:g} is left out: the flow would not rise with it"
        if each["ratio_spread_percent"] > 100.0 * RATIO_SPREAD_MAX:
            yield (
                f"warning: weighed over metered flow differs by {each['ratio_spread_percent']:.1f} "
                "% between duties; weigh again, or the meter is not linear over this range"
            )
    yield f"{result['volume_l']:.1f} L were used"
    yield "paste over the [[nozzle_set]] of these valves, or give --write:"
    yield ""
    yield from result["toml"].splitlines()

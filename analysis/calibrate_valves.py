"""`vrspray calibrate valves`: each valve by itself, on the ground, read by the flow meter."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, date, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from analysis.calibration.steps import CarriedOut, FlowRecord, Order, orders_of
from analysis.calibration.valves import (
    CYCLES,
    WORN_SHARE,
    Piece,
    ValveCourseError,
    counted_course,
    course_of,
    identify_caught,
    identify_valves,
)
from analysis.write_back import Write, written_lines
from companion.cli.answer import AsJson, ConfigFile, Overrides, answer, note
from companion.core.inputs import AutopilotLiquid
from companion.core.schedule import LagModel
from companion.errors import ConfigError

if TYPE_CHECKING:
    from analysis.calibration.valves import Course, IdentifiedValves
    from companion.config import Config
    from companion.core.nozzle import NozzleSet
    from companion.core.types import Input
    from companion.ground.shell import GroundLink, GroundOutcome
    from companion.ground.work import GroundDecision, GroundTask
    from companion.sensors import EdgeSource, Meter

# Options of what is measured by pieces of ground work.
HoldLines = Annotated[
    bool,
    typer.Option("--hold-lines", help="Lines on stdin hold instead of the space bar: for scripts."),
]
Keep = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Keep the record (JSON), to evaluate it again."),
]
Record = Annotated[
    Path | None,
    typer.Option("--from", metavar="FILE", help="Evaluate a record kept by --out; opens no valve."),
]

MS = 1000.0
# A piece that was broken off is done again so many times before it is given up.
TRIES = 3
# Counts of the autopilot come three times a second; a longer silence hides a part of the flow.
COUNT_GAP_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What one piece of ground work brought: how it ended, its plans, the meter's pulses."""

    outcome: GroundOutcome
    plans: CarriedOut
    time_s: Sequence[float]
    volume_ml: Sequence[float]
    fault: str = ""


Measure = Callable[["GroundTask"], Measured]


class PulseRecorder:
    """The flow meter as a sensor of ground work: keeps the time of every pulse.

    Implements `companion.ports.Sensor`.
    """

    def __init__(self, meter: Meter, source: EdgeSource) -> None:
        from companion.sensors import PulseCounter

        self._counter, self._source = PulseCounter(meter), source
        self.time_s: list[float] = []
        self.volume_ml: list[float] = []
        self.fault = ""

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Take the line: SensorError where that cannot be had."""
        self._source.open()

    def read(self, now_s: float) -> Sequence[Input]:
        """Take down what was counted; ground work itself needs none of it."""
        if not self.time_s:
            self._keep(now_s)
        try:
            edges = self._source.read()
        except OSError as error:
            self.fault = f"flow meter: its line cannot be read: {error.strerror or error}"
            return []
        for edge in edges:
            before = self._counter.count
            self._counter.take(edge)
            if self._counter.count > before and edge.at_s > self.time_s[-1]:
                self._keep(edge.at_s)
        self.fault = self.fault or self._counter.fault(now_s)
        return []

    def _keep(self, at_s: float) -> None:
        self.time_s.append(at_s)
        self.volume_ml.append(self._counter.volume_ml)

    async def close(self) -> None:
        """Let go of the line."""
        self._source.close()


class CountRecorder:
    """The autopilot's flow meter: keeps every count of it that the link hears in ground work."""

    def __init__(self, battery: int) -> None:
        from companion.cli.doctor_click import Readings

        self._battery, self._readings = battery, Readings()

    def around(self, link: GroundLink) -> GroundLink:
        """Return the link with the counts taken down."""
        from companion.cli.doctor_click import HeardLink

        return HeardLink(link, self._readings, AutopilotLiquid(flow_battery=self._battery))

    @property
    def time_s(self) -> list[float]:
        """Return when each count came."""
        return [each.received_s for each in self._readings.counts]

    @property
    def volume_ml(self) -> list[float]:
        """Return the counts."""
        return [each.volume_ml for each in self._readings.counts]

    @property
    def fault(self) -> str:
        """Return why the counts cannot be used."""
        counts = self._readings.counts
        if not counts:
            return (
                f"the autopilot sends no count of battery monitor {self._battery}; look at "
                "flow_meter.battery, and at BATTn_MONITOR = 11 on ArduPilot (PX4 has no such meter)"
            )
        told = next((each.fault for each in counts if each.fault), "")
        if told:
            return told
        for before, after in pairwise(counts):
            if not after.volume_ml >= before.volume_ml:
                return "flow meter: the autopilot's count has restarted"
            if not after.received_s - before.received_s <= COUNT_GAP_S:
                gap_s = after.received_s - before.received_s
                return f"flow meter: no count of the autopilot for {gap_s:.1f} s"
        return ""


def valves(
    config_file: ConfigFile,
    cycles: Annotated[
        int, typer.Option(min=6, max=200, help="How often each valve makes each kind of change.")
    ] = CYCLES,
    is_among: Annotated[
        bool,
        typer.Option(
            "--others-open",
            help="Leave the other valves open: for a meter that cannot read one alone.",
        ),
    ] = False,
    is_lines: HoldLines = False,
    out: Keep = None,
    record: Record = None,
    catch: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Without a meter: columns valve, seconds, millilitres of a catch; flow only.",
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture of all valves.")] = None,
    overrides: Overrides = None,
    is_write: Write = False,
    as_json: AsJson = False,
) -> None:
    """Measure the flow and the lags of each valve.

    With water, disarmed, on the ground, while you hold a key. Exit 1: the measurement failed.

    Example: vrspray calibrate valves --config config.toml --plot valves.png --write
    """
    from companion.cli.output_parts import load_with_kept

    config, given = load_with_kept(config_file, tuple(overrides or ()))
    if config.makes_flow:
        raise ConfigError(
            f"{config_file}: the pump makes the flow and the valves only open and shut, so none "
            "is dosed by itself; measure the pump with `vrspray calibrate flow`"
        )
    names = [valve.name for valve in config.valve]
    if len(names) < 2:
        raise ConfigError(f"{config_file}: has one valve; there is none to compare it with")
    day = datetime.now(UTC).astimezone().date().isoformat()
    if catch is not None:
        result = as_shape(identify_caught(read_catch(catch, names)), names, None, day)
    else:
        if record is not None:
            pieces, recorded_on = read_record(record, names)
            day = recorded_on or day
        else:
            course = _course(config, cycles, is_alone=not is_among)
            pieces = _measured_here(config, given, course, is_lines=is_lines)
            if out is not None:
                write_record(out, names, pieces, day)
        try:
            found = identify_valves(pieces, len(names))
        except ValveCourseError as error:
            raise failed(error, as_json=as_json) from error
        result = as_shape(found, names, config.lag_model(), day)
        if plot is not None:
            from analysis.calibrate_plots import plot_valves

            plot_valves(found, names, plot)
    changed = written_lines(config_file, result, is_write=is_write)
    answer(result, [*lines(result), *changed], as_json=as_json)


def failed(error: Exception, *, as_json: bool) -> typer.Exit:
    """Say why a measurement failed, and return the end of the command that goes with it."""
    answer({"error": str(error)} if as_json else {}, (), as_json=as_json)
    note(f"error: {error}")
    return typer.Exit(1)


def _course(config: Config, cycles: int, *, is_alone: bool) -> Course:
    """Return the course for the meter that there is."""
    if config.flow_meter.source == "autopilot":
        return counted_course(config.pwm_limits(), cycles=cycles, is_alone=is_alone)
    return course_of(config.pwm_limits(), config.lag_model(), cycles=cycles, is_alone=is_alone)


def _measured_here(
    config: Config, given: tuple[str, ...], course: Course, *, is_lines: bool
) -> list[Piece]:
    """Do all pieces with the configured outputs and the meter, while a key is held."""
    from companion.cli.sensor_parts import pulse_meter

    if pulse_meter(config) is None and not course.is_counted:
        raise ConfigError(
            'calibrate valves: needs a flow meter ([flow_meter] source = "gpio", or "autopilot" '
            "for the flow alone); without one catch each valve by itself and give --catch CSV"
        )
    told = [*course_lines(config, course)]
    if course.is_counted:
        told.append(
            "The autopilot counts whole millilitres, late by an unknown time: flow factors only. "
            'Lags need the pulses themselves ([flow_meter] source = "gpio").'
        )
    return measured_pieces(config, course, measuring(config, given, told, is_lines=is_lines))


def measuring(
    config: Config, given: tuple[str, ...], told: Sequence[str], *, is_lines: bool
) -> Measure:
    """Say what will be done, ask for the word, and return what does each piece."""
    from companion.cli.ground import (
        INTERRUPTED,
        Hand,
        append,
        ask,
        listening,
        perform,
        ready_log,
    )
    from companion.cli.ground_tasks import drives_while
    from companion.cli.sensor_parts import pulse_meter

    parts = pulse_meter(config)
    log = ready_log(config.resolve(config.journal.folder))
    descriptor = listening(is_lines)
    for line in told:
        note(line)
    ask("spray", config, descriptor)

    def measure(task: GroundTask) -> Measured:
        plans = CarriedOut(valve_count=len(config.valve))
        counts = CountRecorder(config.flow_meter.battery)
        pulses = None if parts is None else PulseRecorder(*parts)

        def on_step(decision: GroundDecision) -> None:
            plans.take(decision.plan, decision.now_s)

        hand = Hand(descriptor, is_lines=is_lines)
        sensors, hear = ([], counts.around) if pulses is None else ([pulses], _as_it_is)
        # The same for all of a piece: what changes with the duty would change the pressure, too.
        most = max(max(phase.duty) for phase in task.phases)
        task = replace(task, drives=drives_while(config, range(len(config.valve)), most))
        outcome = perform(config, given, task, hand, sensors=sensors, on_step=on_step, hear=hear)
        if outcome.has_begun:
            trouble = append(log, _logged(task, outcome))
            if trouble is not None:
                note(f"warning: {trouble}")
        if INTERRUPTED in outcome.reasons:
            raise KeyboardInterrupt
        plans.finish()
        if pulses is None and outcome.is_done and not counts.time_s:
            raise ValveCourseError(counts.fault)
        meter = counts if pulses is None else pulses
        return Measured(
            outcome=outcome,
            plans=plans,
            time_s=meter.time_s,
            volume_ml=meter.volume_ml,
            fault=meter.fault if outcome.is_done else "",
        )

    return measure


def _logged(task: GroundTask, outcome: GroundOutcome) -> dict[str, Any]:
    """Return what the log of ground work keeps of a piece."""
    return {
        "ended_utc": datetime.now(UTC).isoformat(),
        "kind": str(task.kind),
        "open_s": round(outcome.open_s, 4),
        "is_done": outcome.is_done,
        "reasons": sorted(str(reason) for reason in outcome.reasons),
        "training": "ground",
        "liquid": "water",
    }


def _as_it_is(link: GroundLink) -> GroundLink:
    return link


def measured_pieces(config: Config, course: Course, measure: Measure) -> list[Piece]:
    """Return the record of every piece; one that was broken off is done again.

    Raises:
        ValveCourseError: naming the piece that could not be done.
    """
    names = [valve.name for valve in config.valve]
    largest = config.nozzle_sets()[-1]
    pieces: list[Piece] = []
    for valve, number in course.rounds(len(names)):
        what = f"valve {names[valve]}, piece {number} of {course.pieces}"
        done = done_at_last(measure, course.task(valve, len(names)), what)
        record = record_of_piece(done, config, largest)
        pieces.append(Piece(valve=valve, record=record, is_counted=course.is_counted))
    return pieces


def done_at_last(measure: Measure, task: GroundTask, what: str) -> Measured:
    """Do one piece; one that was broken off is done again, some times.

    Raises:
        ValveCourseError: naming the piece that could not be done.
    """
    from companion.cli.ground import in_words

    for _ in range(TRIES):
        note(f"{what}: {task.seconds:.0f} s")
        done = measure(task)
        why = done.fault or (
            "" if done.outcome.is_done else in_words(done.outcome.reasons, done.outcome.text)
        )
        if not why:
            return done
        note(f"{what}: {why}")
        if not done.outcome.has_begun:
            raise ValveCourseError(f"{what}: nothing was opened: {why}")
    raise ValveCourseError(f"{what}: given up after {TRIES} tries: {why}")


def record_of_piece(done: Measured, config: Config, nozzles: NozzleSet) -> FlowRecord:
    """Return what a piece has recorded; its orders with the flow of a set's curve."""
    return FlowRecord(
        orders=orders_of(done.plans, nozzles),
        time_s=np.array(done.time_s, dtype=np.float64),
        volume_ml=np.array(done.volume_ml, dtype=np.float64),
        period_s=config.pwm_limits().period_s,
        lag=config.lag_model(),
    )


def course_lines(config: Config, course: Course) -> Iterator[str]:
    """Yield in words what will be done, and what it takes."""
    count = len(config.valve)
    seconds, open_s = course.open_s(count)
    largest = config.nozzle_sets()[-1]
    litres = open_s / 60.0 * largest.flow_max_l_min / len(largest.valves)
    how = "each by itself" if not course.base else "each while the others spray"
    yield (
        f"{count} valves, {how}: {course.pieces * count} pieces of {course.piece_s:.0f} s, "
        f"about {seconds / 60.0:.0f} min and {litres:.1f} L of water in all"
    )


# What was recorded, to be evaluated again.

FORMAT = "vrspray-valves-1"


def write_record(path: Path, names: Sequence[str], pieces: Sequence[Piece], day: str) -> None:
    """Write what was recorded as JSON; ConfigError where that cannot be."""
    first = pieces[0].record
    write_json(
        path,
        {
            "format": FORMAT,
            "valves": list(names),
            "measured_on": day,
            "is_counted": pieces[0].is_counted,
            "period_s": first.period_s,
            "lag": asdict(first.lag),
            "pieces": [{"valve": names[piece.valve], **shape_of(piece.record)} for piece in pieces],
        },
    )


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a record; ConfigError where that cannot be."""
    try:
        path.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--out {path}: cannot be written ({error})") from error


def shape_of(record: FlowRecord) -> dict[str, Any]:
    """Return a piece's orders and readings as JSON has them."""
    return {
        "orders": [asdict(order) for order in record.orders],
        "time_s": [round(at_s, 6) for at_s in record.time_s.tolist()],
        "volume_ml": [round(ml, 4) for ml in record.volume_ml.tolist()],
    }


def read_json(path: Path, names: Sequence[str], kind: str) -> dict[str, Any]:
    """Return a record of a kind; ConfigError where it is none, or of other valves."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"--from {path}: cannot be read ({error})") from error
    if not isinstance(document, dict) or document.get("format") != kind:
        raise ConfigError(f"--from {path}: is not a record that --out wrote")
    if document.get("valves") != list(names):
        raise ConfigError(f"--from {path}: is of other valves than the configuration has")
    return document


def record_in(document: dict[str, Any], piece: dict[str, Any]) -> FlowRecord:
    """Return a piece of a record as it was measured; KeyError and such where it is damaged."""
    return FlowRecord(
        orders=tuple(Order(**order) for order in piece["orders"]),
        time_s=np.array(piece["time_s"], dtype=np.float64),
        volume_ml=np.array(piece["volume_ml"], dtype=np.float64),
        period_s=float(document["period_s"]),
        lag=LagModel(**document["lag"]),
    )


def read_record(path: Path, names: Sequence[str]) -> tuple[list[Piece], str | None]:
    """Return what `write_record` wrote, and its day; ConfigError where it is of other valves."""
    document = read_json(path, names, FORMAT)
    try:
        pieces = [
            Piece(
                is_counted=bool(document.get("is_counted", False)),
                valve=list(names).index(piece["valve"]),
                record=record_in(document, piece),
            )
            for piece in document["pieces"]
        ]
        day = document.get("measured_on")
        return pieces, None if day is None else date.fromisoformat(day).isoformat()
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"--from {path}: is damaged ({error!r})") from error


def read_catch(path: Path, names: Sequence[str]) -> list[list[float]]:
    """Return what was caught of each valve [mL/s], a figure for each catch.

    Columns valve, seconds, millilitres, of catches at one duty.
    """
    from analysis.csv_rows import TableError, read_rows

    caught: list[list[float]] = [[] for _ in names]
    for row in read_rows(path, ("valve", "seconds", "millilitres")):
        name = row.text("valve")
        if name is None or name not in names:
            raise row.error(f"valve is {name!r}; the valves are {', '.join(names)}")
        seconds = row.needed("seconds", low=1.0, high=3600.0)
        caught[list(names).index(name)].append(
            row.needed("millilitres", low=1.0, high=1e6) / seconds
        )
    for name, flows in zip(names, caught, strict=True):
        if len(flows) < 2:
            raise TableError(f"{path}: valve {name} was caught {len(flows)} times; two are needed")
    return caught


# The answer.


def as_shape(
    found: IdentifiedValves, names: Sequence[str], configured: LagModel | None, day: str
) -> dict[str, Any]:
    """Return the answer: each valve, the set's own lags beside the configured ones, TOML."""
    return {
        "valves": [
            {
                "name": name,
                "flow_factor": _figures(own.factor),
                "lags": {f"lag_{kind.value}_s": _figures(lag) for kind, lag in own.lags.items()},
                "is_worn": own.is_worn,
            }
            for name, own in zip(names, found.valves, strict=True)
        ],
        "set_lags": {
            f"{kind.value}_s": _figures(lag)
            | ({} if configured is None else {"configured": getattr(configured, f"{kind.value}_s")})
            for kind, lag in found.lags.items()
        },
        "volume_l": None if math.isnan(found.volume_ml) else found.volume_ml / 1000.0,
        "toml": "\n".join(toml_lines(found, names, day)),
    }


def _figures(estimate: Any) -> dict[str, float]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def toml_lines(found: IdentifiedValves, names: Sequence[str], day: str) -> Iterator[str]:
    """Yield the keys of the `[[valve]]` tables that were measured on a day, with water."""
    for name, own in zip(names, found.valves, strict=True):
        yield "[[valve]]"
        yield f"name = {json.dumps(name)}"
        yield f"flow_factor = {own.factor.value:.4f}"
        for kind, lag in own.lags.items():
            yield f"lag_{kind.value}_s = {lag.value:.4f}"
        yield f'measured_on = "{day}"'
        yield 'measured_with = "water"'


def lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the answer for a person."""
    yield "each valve against the mean of all; 95 % interval:"
    for valve in result["valves"]:
        factor = valve["flow_factor"]
        text = f"  {valve['name']:>4s}  flow {factor['value']:.3f} +- {_half(factor):.3f}"
        for key, lag in valve["lags"].items():
            kind = key.removeprefix("lag_").removesuffix("_s")
            text += f"   {kind} {lag['value'] * MS:+.1f} +- {_half(lag) * MS:.1f} ms"
        yield text
    for valve in result["valves"]:
        if valve["is_worn"]:
            off = 100.0 * (valve["flow_factor"]["value"] - 1.0)
            why = "worn, or of another size" if off > 0.0 else "blocked, or of another size"
            yield (
                f"valve {valve['name']}: {off:+.0f} % from the others, more than "
                f"{100.0 * WORN_SHARE:.0f} %: its nozzle is {why}; clean or replace it, then "
                "measure again"
            )
    for key, lag in result["set_lags"].items():
        told = f" (configured: {lag['configured'] * MS:.1f})" if "configured" in lag else ""
        yield f"mean of all valves, {key.removesuffix('_s')}: {lag['value'] * MS:.1f} ms{told}"
    if result["volume_l"] is not None:
        yield f"{result['volume_l']:.1f} L were used"
    yield "paste into the [[valve]] tables of these names, or give --write:"
    yield ""
    yield from result["toml"].splitlines()


def _half(figures: dict[str, float]) -> float:
    return 0.5 * (figures["high"] - figures["low"])

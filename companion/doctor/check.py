"""One check of the doctor: what was looked at, how it is, what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import date, datetime
from enum import StrEnum

from companion.assembly import beyond_label
from companion.config import Config
from companion.config.application_table import zone_named
from companion.config.legal_entries import missing
from companion.config.limits import LimitsFile
from companion.core.label import is_hour


class Status(StrEnum):
    """How a check ended; the values stand in the JSON."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"
    NOT_APPLICABLE = "not-applicable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A check by its name. What is not in order says in one line how it is put in order.

    `is_open` where a flight depends on an answer that nobody has given: that is not ready either.
    """

    name: str
    status: Status
    text: str
    fix: str = ""
    is_open: bool = False

    def __post_init__(self) -> None:
        if self.status in (Status.WARN, Status.FAIL) and not self.fix:
            raise ValueError(f"check {self.name} says {self.status} without a fix")
        for line in (self.text, self.fix):
            if "\n" in line:
                raise ValueError(f"check {self.name}: one line only, got {line!r}")

    def as_object(self) -> dict[str, str]:
        """Return it as it stands in the JSON."""
        return {
            "name": self.name,
            "status": self.status.value,
            "text": self.text,
            "fix": self.fix,
        }

    def line(self) -> str:
        """Return it for a person.

        >>> warn("clock", "not synchronised", "connect to a time server").line()
        'warn  clock: not synchronised; connect to a time server'
        """
        mark = "-" if self.status is Status.NOT_APPLICABLE else self.status.value
        fix = f"; {self.fix}" if self.fix else ""
        return f"{mark:<5} {self.name}: {self.text}{fix}"


def ok(name: str, text: str) -> Check:
    """Return a check that found all in order."""
    return Check(name=name, status=Status.OK, text=_one_line(text))


def warn(name: str, text: str, fix: str) -> Check:
    """Return a check after which a flight is possible and something should be seen to."""
    return Check(name=name, status=Status.WARN, text=_one_line(text), fix=_one_line(fix))


def fail(name: str, text: str, fix: str) -> Check:
    """Return a check after which no flight should begin."""
    return Check(name=name, status=Status.FAIL, text=_one_line(text), fix=_one_line(fix))


def not_applicable(name: str, why: str) -> Check:
    """Return a check that has no meaning here, or could not be made."""
    return Check(name=name, status=Status.NOT_APPLICABLE, text=_one_line(why))


def is_ready(checks: Iterable[Check]) -> bool:
    """Return whether no check failed, and none waits for an answer.

    >>> is_ready([ok("map", "9 zones"), warn("clock", "not synchronised", "wait")])
    True
    """
    return all(check.status is not Status.FAIL and not check.is_open for check in checks)


def split_advice(line: str, otherwise: str) -> tuple[str, str]:
    """Return what is wrong and what to do, of a line that says both; else with other advice.

    >>> split_advice("a.toml: lag.on_s = 99: out of range; write less", "see the docs")
    ('a.toml: lag.on_s = 99: out of range', 'write less')
    >>> split_advice("no bytes come in: is the cable right?", "see the docs")
    ('no bytes come in', 'is the cable right?')
    >>> split_advice("broken", "see the docs")
    ('broken', 'see the docs')
    """
    for mark in ("; ", ": "):
        what, found, advice = line.rpartition(mark)
        if found:
            return what, advice
    return line, otherwise


def _one_line(text: str) -> str:
    return " ".join(text.split())


# Is all there that the legal record of an application wants from the operator.

NAME = "application-record"


def application_check(config: Config) -> Check:
    """Return whether the record of the chosen profile could be complete after this flight."""
    table = config.application
    if config.output.kind == "none" or config.journal.training:
        return not_applicable(NAME, "training: no product is applied")
    if table.profile is None:
        return warn(
            NAME,
            "application.profile is not set: no legal record is asked for",
            'write profile = "eu", "us", "australia" or "generic" under [application]',
        )
    absent = missing(table.profile, config.told())
    if absent:
        return warn(
            NAME,
            f"{table.profile}: missing: {', '.join(absent)}",
            "write them before the flight; docs/howto/legal-record.md has all",
        )
    if table.time_zone is not None and zone_named(table.time_zone) is None:
        return warn(
            NAME,
            f"application.time_zone = {table.time_zone}: no time zone that this computer knows",
            "write one such as Europe/Madrid",
        )
    return ok(NAME, f"{table.profile}: all there that the operator must say")


def label_check(config: Config, now: datetime) -> Check:
    """Return whether what is known before the flight keeps the limits of label and permit."""
    name, label = "label-limits", config.label
    if label is None:
        return not_applicable(name, "no limits file: label and permit are not checked")
    problems = beyond_label(config)
    for problem in problems:
        if problem.severity == "error":
            return fail(name, f"{label.title}: {problem.text}", problem.fix)
    found = _declared_check(name, label, config.told()) or _time_check(name, label, config, now)
    if found.status is Status.OK and problems:
        return warn(name, f"{label.title}: {problems[0].text}", problems[0].fix)
    return found


def _declared_check(name: str, label: LimitsFile, values: Mapping[str, object]) -> Check | None:
    """Return which limit was not declared, or declared not to be kept; None where all are."""
    rows = list(label.declared(values))
    asked = [row for row in rows if row.value is None]
    if asked:
        keys = ", ".join(row.key for row in asked)
        return fail(
            name,
            f"{label.title}: not declared: {keys}; the valves stay closed",
            f"measure, then start with --set {asked[0].key}=VALUE",
        )
    broken = [row for row in rows if not row.is_kept]
    if broken:
        first = broken[0]
        return fail(
            name,
            f"{label.title}: {first.key} = {first.value}, allowed is {first.words}",
            "wait until it is so, then declare it again",
        )
    return None


def _time_check(name: str, label: LimitsFile, config: Config, now: datetime) -> Check:
    """Return whether what was declared still counts, at an hour that is allowed."""
    flown = label.flown(config.told())
    seen_s = flown.observed_s
    if seen_s is not None and not seen_s[0] <= now.timestamp() < seen_s[1]:
        return fail(
            name,
            f"{label.title}: the weather was observed at {config.application.observed_at}; it "
            f"counts for {label.observed_max_h:g} h",
            "observe it again, and declare it with its time",
        )
    if not is_hour(flown, now.timestamp()):
        return fail(
            name,
            f"{label.title}: it does not allow spraying at this hour or day ({label.when()})",
            "wait for them; by the autopilot's clock the valves stay closed until then",
        )
    return ok(name, f"{label.title}: what is declared is kept; the rest is checked in flight")


# How old is what was measured.

# Nozzles wear, hoses age, pumps lose pressure: half a year is about one season of spraying.
CALIBRATION_MAX_DAYS = 180
# A nozzle that gives 10 % more or less than the others is replaced (ISO 16122-2, 4.9.2).
WORN_SHARE = 0.10


def calibration_age(measured_on: str | None, today: date) -> Check:
    """Return how old flows and lags are."""
    name = "calibration-age"
    if measured_on is None:
        return warn(
            name,
            "lag.measured_on is not set, so the age of flows and lags is unknown",
            'write the date under [lag], such as measured_on = "2026-05-01"',
        )
    again = "vrspray calibrate flow, vrspray calibrate lag"
    return _judged_age(name, measured_on, today, key="lag.measured_on", again=again)


def valve_age(config: Config, today: date) -> Check:
    """Return how old the figures of single valves are, and with what they were measured."""
    name, again = "valve-calibration", "vrspray calibrate valves"
    own = [valve for valve in config.valve if valve.has_own_figures]
    if not own:
        return not_applicable(name, "no valve has figures of its own")
    for valve in own:
        if abs(valve.flow_factor - 1.0) > WORN_SHARE:
            return warn(
                name,
                f"valve {valve.name} has flow_factor {valve.flow_factor:g}, more than "
                f"{100.0 * WORN_SHARE:.0f} % off: worn or blocked",
                f"clean or replace its nozzle, then {again}",
            )
    days = [valve.measured_on for valve in own if valve.measured_on is not None]
    if len(days) < len(own):
        fix = f"write valve.measured_on and measured_with, or measure again: {again}"
        return warn(name, "valve.measured_on is not set, so their age is unknown", fix)
    liquids = {valve.measured_with or "a liquid that is not said" for valve in own}
    told = f" with {' and '.join(sorted(liquids))}"
    return _judged_age(name, min(days), today, key="valve.measured_on", again=again, told=told)


def _judged_age(
    name: str, measured_on: str, today: date, *, key: str, again: str, told: str = ""
) -> Check:
    fix = f"correct {key}, or the clock of this computer"
    try:
        days = (today - date.fromisoformat(measured_on)).days
    except ValueError:
        return warn(name, f"{measured_on} is not a date", fix)
    if not days >= 0:
        return warn(name, f"measured on {measured_on}, which is in the future", fix)
    if not days <= CALIBRATION_MAX_DAYS:
        return warn(name, f"measured {days} days ago{told}", f"measure again: {again}")
    return ok(name, f"measured {days} days ago{told}")

"""The report of a job: one field that was sprayed in several sorties, days or by several aircraft.

Each sortie is evaluated as in a report of its own. Ground counts once, doses add up on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.assess.assessment import figures_of, together
from analysis.assess.ground import treated_of
from analysis.journals.jobs import one_job, pauses
from analysis.report.build import (
    Judged,
    Report,
    ReportOptions,
    Say,
    judged,
    profiles_of,
    volumes,
    with_files,
)
from analysis.report.contents import Caution, record_warnings, verdict_of
from analysis.report.legal import legal_record
from analysis.report.legal_fields import Facts, Told
from companion.cli.answer import finite
from companion.errors import ConfigError
from companion.simulated import SIMULATED

if TYPE_CHECKING:
    from analysis.assess.assessment import Essentials, Figures
    from analysis.assess.ground import Treated
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.journals.jobs import Sortie
    from analysis.report.figure_style import Drawn
    from analysis.report.legal import LegalRecord

# Ground that lies elsewhere by more was moved by an offset of the map.
MOVED_M = 0.02
# Litres of two products are no sum.
OF_PRODUCT = ("product.", "application.product_")


def build_job(
    journals: Sequence[Path], options: ReportOptions, *, say: Say = lambda _: None
) -> Report:
    """Return the report of all sorties of a job; nothing is written.

    Raises:
        JournalError: where a file is no journal, or its flight still writes it.
        ConfigError: where they are not of one field and product, or an option is wrong.
    """
    sorties = one_job(journals)
    parts = [judged(each.path, options, say=say) for each in sorties]
    _refuse_moved(parts)
    names = [each.path.name for each in sorties]
    if len({*names}) < len(names):  # of several aircraft, or simulated ones
        names = ["/".join(each.path.parts[-2:]) for each in sorties]
    for each, name in zip(parts, names, strict=True):
        each.contents["flight"]["file"] = name
    treated = treated_of(*(each.flight for each in parts))
    flown = [each.assessment for each in parts if each.assessment is not None]
    found = together(flown, treated) if flown else None
    is_whole = all(not (p.contents["flight"]["unread"] or p.flight.lost) for p in parts)
    figures = figures_of(found, area_ha=treated.area_ha, is_whole=is_whole)
    told = _told(parts)
    rows = list(_rows(parts))
    facts = _facts([each.facts for each in parts], treated, parts[0].flight, figures)
    last = max((each.facts.date for each in parts if each.facts.date), default=None)
    records = [
        replace(legal_record(profile, told, facts), sorties=rows, date=last)
        for profile in profiles_of(options, told)
    ]
    contents: dict[str, Any] = finite(
        {
            **{key: parts[0].contents[key] for key in ("report_version", "program", "definitions")},
            "flight": _flight(parts, told, figures),
            "job": next((each.job for each in sorties if each.job), None),
            "sorties": rows,
            "verdict": verdict_of(
                figures,
                SIMULATED if facts.simulated.is_simulated else facts.training,
                is_whole=is_whole,
            ),
            "warnings": [each.as_json() for each in _warnings(parts, sorties, records)],
            **({} if found is None else {"balance": found.balance.as_json()}),
            "label": _label(parts),
            "application": {record.profile: record.as_json() for record in records},
            "events": [event for each in parts for event in each.contents["events"]],
        }
    )
    drawings: Iterable[Drawn] = ()
    if options.with_figures and found is not None:
        say("drawing")
        drawings = _drawings([each.flight for each in parts], found)
    return with_files(contents, records, facts.simulated, drawings, options)


def _refuse_moved(parts: Sequence[Judged]) -> None:
    """Refuse ground that an offset of the map moved: places of two sorties are not the same."""
    first, *others = (np.array(each.flight.setup.prescription.field.bounds) for each in parts)
    for bounds, each in zip(others, parts[1:], strict=True):
        if not np.abs(bounds - first).max(initial=0.0) <= MOVED_M:
            raise ConfigError(
                f"{each.flight.path}: its ground lies elsewhere than that of "
                f"{parts[0].flight.path} (prescription.offset_east_m, offset_north_m, boundary or "
                "exclusions); report each by itself"
            )


def _told(parts: Sequence[Judged]) -> Told:
    """Return what was said of all sorties; where they differ, all of it in their order."""
    values: dict[str, Any] = {}
    for key in dict.fromkeys(key for each in parts for key in each.told.values):
        said = list(dict.fromkeys(each.told.values.get(key) for each in parts))
        if len(said) > 1 and key.startswith(OF_PRODUCT):
            raise ConfigError(
                f"{key}: {' and '.join(map(str, said))} in one job; report each product by itself, "
                f"or correct it with --set {key}=VALUE"
            )
        known = [each for each in said if each is not None]
        values[key] = known[0] if len(known) == 1 else "; ".join(map(str, known))
    return replace(
        parts[0].told,
        values=values,
        after=frozenset(key for each in parts for key in each.told.after),
        before={key: value for each in parts for key, value in each.told.before.items()},
    )


def _facts(
    every: Sequence[Facts], treated: Treated, flight: AppliedFlight, figures: Figures
) -> Facts:
    """Return what the journals say together; means are by the ground of each."""
    wet = [each for each in every if each.has_area] or list(every)
    unsure = next((each for each in wet if each.clock_source == "computer"), wet[0])

    def mean(name: str) -> float | None:
        known = [each for each in wet if getattr(each, name) is not None]
        area = [each.area_ha for each in known]
        its = [getattr(each, name) for each in known]
        return float(np.average(its, weights=area)) if sum(area) > 0.0 else None

    said = volumes(figures)
    return replace(
        wet[0],
        end_time=wet[-1].end_time,
        time_said=unsure.time_said,
        clock_source=unsure.clock_source,
        area_ha=treated.area_ha,
        volume_l=said["volume_l"],
        volume_by=said["volume_by"],
        modelled_l=said["modelled_l"],
        mean_rate_l_ha=figures.mean_rate_l_ha,
        asked_rate_l_ha=figures.asked_rate_l_ha,
        boom_width_m=max(each.boom_width_m for each in every),
        height_m=mean("height_m"),
        speed_m_s=mean("speed_m_s"),
        wind_m_s=mean("wind_m_s"),
        is_closed=all(each.is_closed for each in every),
        lost_rows=sum(each.lost_rows for each in every),
        ends_spraying=any(each.ends_spraying for each in every),
        treated_area=treated.as_geojson(flight.setup.frame),
    )


def _rows(parts: Sequence[Judged]) -> Iterator[dict[str, Any]]:
    """Yield each sortie; what was filled in is by the level where the same aircraft landed."""
    levels: dict[object, float] = {}
    for number, each in enumerate(parts, start=1):
        flight, verdict = each.contents["flight"], each.contents["verdict"]
        aircraft = each.told.values.get("application.aircraft")
        tank = each.contents.get("balance") or {}
        start_l, end_l = tank.get("tank_start_l"), tank.get("tank_end_l")
        filled_l = tank.get("refilled_l")
        if start_l is not None and filled_l is not None:
            filled_l += max(start_l - levels.get(aircraft, start_l), 0.0)
            levels[aircraft] = start_l if end_l is None else end_l
        yield {
            "sortie": number,
            "journal": flight["file"],
            "sha256": flight["sha256"],
            "aircraft": aircraft,
            **{key: flight[key] for key in ("spraying_from", "spraying_until", "duration_s")},
            **{
                key: verdict[key]
                for key in ("applied_l", "applied_by", "metered_l", "modelled_l", "area_ha")
            },
            "outside_ml": verdict["outside_ml"],
            "boom_width_m": each.facts.boom_width_m,
            "tank_start_l": start_l,
            "tank_end_l": end_l,
            "filled_l": filled_l,
        }


def _flight(parts: Sequence[Judged], told: Told, figures: Figures) -> dict[str, Any]:
    """Return what, where, when and by whom, of all."""
    every = [each.contents["flight"] for each in parts]

    def ends(begin: str, end: str) -> dict[str, Any]:
        first = next((each[begin] for each in every if each[begin]), None)
        return {begin: first, end: next((each[end] for each in every[::-1] if each[end]), None)}

    return {
        **every[0],
        **ends("started", "ended"),
        **ends("spraying_from", "spraying_until"),
        "file": ", ".join(each["file"] for each in every),
        "sha256": None,
        "is_closed": all(each["is_closed"] for each in every),
        "lost": sum(each["lost"] for each in every),
        "unread": [text for each in every for text in each["unread"]],
        "duration_s": sum(each["duration_s"] or 0.0 for each in every),
        "treated_area_ha": figures.area_ha,
        "told": dict(told.values),
        "told_after_flight": sorted(told.after),
    }


def _warnings(
    parts: Sequence[Judged], sorties: Sequence[Sortie], records: Sequence[LegalRecord]
) -> Iterator[Caution]:
    """Yield what must be known, the gravest first, and of which sorties it is said."""
    said: dict[tuple[Any, ...], list[int]] = {}
    for number, each in enumerate(parts, start=1):
        for caution in each.contents["warnings"]:
            if caution["code"] != "record":
                said.setdefault(tuple(caution.values()), []).append(number)
    for severity in ("mark", "warning", "note"):
        for (its, code, text), numbers in said.items():
            if its == severity:
                who = f"Sortie {', '.join(map(str, numbers))}: "
                prefix = "" if severity == "mark" or len(numbers) == len(parts) else who
                yield Caution(severity=its, code=code, text=prefix + text)
        if severity == "mark":
            for number, days in pauses(sorties):
                yield Caution(
                    severity="warning",
                    code="pause",
                    text=f"Sortie {number + 1} began {days:.0f} days after sortie {number}: if it "
                    "was a second treatment, its doses stand added to the first.",
                )
            yield from record_warnings(records)


def _label(parts: Sequence[Judged]) -> dict[str, Any] | None:
    """Return the limits of all sorties; kept are they where every one kept them."""
    found: list[tuple[int, Mapping[str, Any]]] = [
        (number, each.contents["label"])
        for number, each in enumerate(parts, start=1)
        if each.contents["label"]
    ]
    if not found:
        return None
    return {
        "title": found[0][1]["title"],
        "limits": [
            {**row, "name": f"sortie {number}: {row['name']}"}
            for number, its in found
            for row in its["limits"]
        ],
        "kept": len(found) == len(parts) and all(its["kept"] for _, its in found),
        "reentry_from": max((its["reentry_from"] or "" for _, its in found)) or None,
    }


def _drawings(flights: Sequence[AppliedFlight], found: Essentials) -> Iterator[Drawn]:
    """Yield the maps of the job, with the paths of all its flights."""
    from analysis.report.drawing import deviation, prescribed_and_applied
    from analysis.report.figure_style import PATH_POINTS_MAX, sheet_of

    if found.cells is None:
        return
    every = max(1, sum(len(each.time_s) for each in flights) // PATH_POINTS_MAX)

    # Nothing is drawn from where one landed to where the next took off.
    path: dict[str, Any] = {
        name: np.concatenate([np.append(getattr(each, name)[::every], np.nan) for each in flights])
        for name in ("time_s", "east_m", "north_m")
    }
    sheet = sheet_of(replace(flights[0], **path), found.cells)
    yield prescribed_and_applied(sheet)
    yield deviation(sheet)

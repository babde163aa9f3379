"""The legal record of an application, by profile: what a law asks for, and what is missing of it.

A record is complete only when every field of its profile has a value, and then only if the flight
was an application at all. Who said what, and when, stands beside each value.

Sources, by profile:

- `eu`: Commission Implementing Regulation (EU) 2023/564 of 10 March 2023 (OJ L 74, 13.3.2023,
  p. 4), Article 1 and annex, with Article 67(1) of Regulation (EC) No 1107/2009: product with its
  authorisation number, use, crop by EPPO code, BBCH stage where the authorisation limits it, area
  as geodata, dose, date and start; electronic and machine-readable. The annex was read only in
  summaries (Landwirtschaftskammer Schleswig-Holstein; Trifolio-M).
- `us`: 14 CFR 137.71(a)(1) to (4) and (b), eCFR of 2026-04.
- `australia`: Pesticides Regulation 2017 (New South Wales), clause 26(4), for aerial and RPA
  applicator business licences, its paragraphs after (e) in the summary of XAG Australia (2024-08);
  Agricultural Chemicals Distribution Control Act 1966 (Queensland), as business.qld.gov.au lists
  the records of aerial distribution. Other states, and labels, may ask for more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from analysis.flown.modelled_flow import meter_text
from analysis.report.clock import SOURCES
from analysis.report.legal_fields import FIELDS, LABELS, REAL_FLIGHT, Facts, label_of
from companion.config.application_table import Profile, is_told
from companion.config.legal_entries import ASKED, missing
from companion.wording import CUT

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from analysis.report.legal_fields import Told
    from companion.simulated import Simulated

LAWS: dict[Profile, str] = {
    "eu": "Commission Implementing Regulation (EU) 2023/564, with Article 67(1) of Regulation (EC) "
    "No 1107/2009",
    "us": "14 CFR 137.71, records of a commercial agricultural aircraft operator",
    "australia": "Pesticides Regulation 2017 (NSW), clause 26(4), and the records of aerial "
    "distribution under the Agricultural Chemicals Distribution Control Act 1966 (Queensland)",
    "generic": "no law's own form: what labels, authorities and buyers commonly ask for",
}
KEEP: dict[Profile, str] = {
    "eu": "keep it for at least three years (Article 67(1) of Regulation (EC) No 1107/2009)",
    "us": "keep it for at least 12 months (14 CFR 137.71(b))",
    "australia": "make it within 48 hours of the application and keep it for at least three years "
    "(NSW, clause 26; Queensland two)",
    "generic": "keep it for as long as your authority asks, commonly two or three years",
}
# The same in years; None where no law says how long.
KEEP_YEARS: dict[Profile, int | None] = {"eu": 3, "us": 1, "australia": 3, "generic": None}
BEFORE, AFTER, FLIGHT = "before the flight", "after the flight", "flight"


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One field of a record; `said` is who says so: the operator before or after, or the flight."""

    name: str
    label: str
    value: Any
    unit: str
    said: str
    replaced: Any = None
    is_optional: bool = False
    key: str = ""

    @property
    def is_missing(self) -> bool:
        """Return whether the record cannot be complete for want of this one."""
        return not (self.is_optional or is_told(self.value))


@dataclass(frozen=True, slots=True, kw_only=True)
class LegalRecord:
    """A record of one profile, complete or not; `why_not` has reasons beside empty fields."""

    profile: Profile
    entries: tuple[Entry, ...]
    why_not: tuple[str, ...]
    remarks: tuple[str, ...]
    simulated: Simulated
    treated_area: dict[str, Any]
    date: str | None = None
    sorties: Sequence[dict[str, Any]] = ()

    @property
    def keep_until(self) -> str | None:
        """Return the first day on which it need not be kept; None where no law or date says.

        Of the 29th of February that is the 1st of March.
        """
        years = KEEP_YEARS[self.profile]
        if years is None or self.date is None:
            return None
        year, month, day = (int(part) for part in self.date.split("-"))
        if (month, day) == (2, 29):
            month, day = 3, 1
        return f"{year + years:04d}-{month:02d}-{day:02d}"

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the names of empty fields, and what else keeps the record from being complete."""
        return (*(entry.name for entry in self.entries if entry.is_missing), *self.why_not)

    @property
    def is_complete(self) -> bool:
        """Return whether nothing is missing."""
        return not self.missing

    @property
    def added_after_flight(self) -> tuple[str, ...]:
        """Return the names of the fields that were said after the flight."""
        return tuple(entry.name for entry in self.entries if entry.said == AFTER)

    def as_json(self) -> dict[str, Any]:
        """Return the record as its JSON file has it."""
        return {
            "profile": self.profile,
            "law": LAWS[self.profile],
            "retention": KEEP[self.profile],
            "retention_years": KEEP_YEARS[self.profile],
            "keep_until": self.keep_until,
            "complete": self.is_complete,
            "simulated": self.simulated.word,
            "simulated_because": self.simulated.because,
            "missing": list(self.missing),
            "added_after_flight": list(self.added_after_flight),
            "fields": {
                entry.name: {
                    "label": entry.label,
                    "value": entry.value,
                    "unit": entry.unit,
                    "said": entry.said,
                    **({"key": entry.key} if entry.key and entry.is_missing else {}),
                    **({} if entry.replaced is None else {"replaced": entry.replaced}),
                }
                for entry in self.entries
            },
            "remarks": list(self.remarks),
            **({"sorties": list(self.sorties)} if self.sorties else {}),
            "treated_area": self.treated_area,
        }


def legal_record(profile: Profile, told: Told, facts: Facts) -> LegalRecord:
    """Return the record of a flight as a profile asks for it."""
    entries = (
        *_said(profile, told, facts),
        *_flown(profile, told, facts),
        *_also_said(profile, told),
    )
    return LegalRecord(
        profile=profile,
        entries=entries,
        why_not=tuple(_why_not(profile, told, facts)),
        remarks=tuple(_remarks(told, facts)),
        simulated=facts.simulated,
        treated_area=facts.treated_area,
        date=facts.date,
    )


def _said(profile: Profile, told: Told, facts: Facts) -> Iterator[Entry]:
    """Yield what the operator says; wind that the flight measured needs no saying."""
    absent = missing(profile, told.values)
    for key in ASKED[profile]:
        if key == "application.wind_m_s" and key in absent and facts.wind_m_s is not None:
            label, unit = label_of(key)
            yield Entry(
                name="wind_m_s",
                label=f"{label}, mean in flight",
                value=round(facts.wind_m_s, 1),
                unit=unit,
                said=FLIGHT,
            )
        else:
            yield _entry(key, told)


def _also_said(profile: Profile, told: Told) -> Iterator[Entry]:
    """Yield what this profile does not ask for and was said all the same."""
    for key in LABELS:
        if key in told.values and key not in ASKED[profile]:
            yield replace(_entry(key, told), is_optional=True)


def _entry(key: str, told: Told) -> Entry:
    table, _, name = key.partition(".")
    label, unit = label_of(key)
    value = told.values.get(key)
    said = "" if value is None else AFTER if key in told.after else BEFORE
    return Entry(
        name=name if table == "application" else f"{table}_{name}",
        label=label,
        value=value,
        unit=unit,
        said=said,
        replaced=told.before.get(key),
        key=key,
    )


def _flown(profile: Profile, told: Told, facts: Facts) -> Iterator[Entry]:
    for field in FIELDS[profile]:
        value = field.value(facts, told)
        said = facts.time_said if field.is_time else FLIGHT
        yield Entry(
            name=field.name,
            label=field.label,
            value=value,
            unit=field.unit(told),
            said=said if is_told(value) else "",
            is_optional=field.is_optional,
        )


def _why_not(profile: Profile, told: Told, facts: Facts) -> Iterator[str]:
    skills_date = told.values.get("application.pilot_skills_date")
    if profile == "us" and skills_date and facts.date and str(skills_date) > facts.date:
        yield f"pilot_skills_date: {skills_date} is after the flight"
    yield from _why_not_real(told, facts)
    if facts.training in ("water", "dry", "simulated"):
        what = "a simulation" if facts.training == "simulated" else f"training ({facts.training})"
        yield f"a product: this was {what}"
    elif not facts.area_ha > 0.0:
        what = (
            "whether anything was sprayed is not known"
            if facts.lost_rows
            else "nothing was sprayed"
        )
        yield f"an application: {what}"
    if facts.ends_spraying:
        yield "the end of the spraying: the journal was cut while valves were open"
    if facts.lost_rows:
        yield f"{facts.lost_rows} lost or unreadable rows of the journal"


def _why_not_real(told: Told, facts: Facts) -> Iterator[str]:
    """Yield that nothing was flown, or that nobody knows; the operator may vouch for the latter.

    Only after the flight: a configuration that says so would vouch for every simulation too.
    """
    simulated = facts.simulated
    if simulated.is_simulated:
        yield f"a real flight: this one was SIMULATED ({simulated.because})"
    elif not (simulated.is_known or simulated.is_unmarked or REAL_FLIGHT in told.after):
        yield (
            f"whether the flight was real: not known whether simulated ({simulated.because}); "
            f"if it was flown, say so with --set {REAL_FLIGHT}=yes"
        )


def _remarks(told: Told, facts: Facts) -> Iterator[str]:
    if facts.has_area:
        beside = ""
        if facts.volume_by == "flow meter" and facts.modelled_l is not None:
            sure = meter_text(facts.volume_l, facts.modelled_l)
            beside = f"{sure}; by the model of the executed changes {facts.modelled_l:.3f} L"
        yield f"quantities are by the {facts.volume_by}{beside}"
    if facts.clock_source == "operator":
        yield "times are as the operator gave them"
    elif facts.clock_source != "autopilot":
        yield f"times are by the {SOURCES[facts.clock_source]}"
    if not facts.is_closed:
        yield CUT
    if facts.wind_note:
        yield facts.wind_note
    if facts.simulated.is_simulated:
        yield f"SIMULATED: {facts.simulated.because}"
    elif not facts.simulated.is_known:
        yield f"not known whether simulated: {facts.simulated.because}"
    if facts.training is None:
        yield "whether product or water was sprayed is not in the journal"
    yield from _remarks_told(told)


def _remarks_told(told: Told) -> Iterator[str]:
    if len(told.periods) > 1:
        yield "weather was declared during the run; the last before the end of spraying stands"
    if is_told(told.values.get("application.remarks")):
        yield str(told.values["application.remarks"])

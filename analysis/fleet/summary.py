"""The fleet summed up: by machine, field, product, operator and month, each kind of flight apart.

All figures are those of the flights' rows, where ground of a job counts once. What only an
evaluated flight tells (missed and apart changes, lags, ground missed) is summed over the evaluated
ones, and the count of the others stands beside it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

from analysis.fleet.row import KINDS
from companion.errors import ConfigError

if TYPE_CHECKING:
    from analysis.fleet.asking import Fleet

Rows = list[dict[str, Any]]

SUMMARY_VERSION = 1
# A line through fewer flights is none.
TREND_FLIGHTS_MIN = 5
_MONTH = re.compile(r"20[0-9]{2}-(0[1-9]|1[0-2])")
_GROUPS = {
    "machine": "coalesce(machine, 'not named')",
    "field": "coalesce(field, 'map ' || left(map_sha256, 8), 'not named')",
    "product": "coalesce(product, 'not named')",
    "operator": "coalesce(operator, 'not named')",
    "month": "month",
}
GROUPS = tuple(_GROUPS)
_DAYS = "epoch(started_utc) / 86400"
_TREND = (
    "CASE WHEN count({value}) >= " + str(TREND_FLIGHTS_MIN) + " AND max({days}) - min({days}) >= 1 "
    "THEN 30 * regr_slope({value}, {days}) END"
)


class Figure(NamedTuple):
    """A column of a summary: its SQL over flights, its heading, digits, and what it means."""

    name: str
    sql: str
    heading: str
    digits: int
    meaning: str


FIGURES = (
    Figure("flights", "count(*)", "flights", 0, "flights"),
    Figure(
        "not_evaluated",
        "count(*) FILTER (NOT is_evaluated)",
        "not evaluated",
        0,
        "flights whose lags, changes and missed ground are not known yet",
    ),
    Figure("hours", "sum(duration_s) / 3600", "h", 1, "hours recorded"),
    Figure("area_ha", "sum(area_ha)", "ha", 2, "ground treated; of a job's sorties once"),
    Figure("applied_l", "sum(applied_l)", "L", 1, "litres, by the meter where there is one"),
    Figure(
        "metered_percent",
        "100 * coalesce(sum(applied_l) FILTER (applied_by = 'flow meter'), 0) / "
        "nullif(sum(applied_l), 0)",
        "metered %",
        0,
        "share of the litres that a flow meter counted; the others are modelled",
    ),
    Figure(
        "rate_l_ha",
        "sum(applied_l) FILTER (area_ha > 0) / nullif(sum(area_ha), 0)",
        "L/ha",
        1,
        "litres on the ground treated",
    ),
    Figure(
        "coverage_percent",
        "100 * sum(area_ha) FILTER (missed_m2 IS NOT NULL) / nullif(sum(area_ha) FILTER "
        "(missed_m2 IS NOT NULL) + sum(missed_m2) / 10000, 0)",
        "coverage %",
        1,
        "of the ground under passes, what was treated",
    ),
    Figure("missed_m2", "sum(missed_m2)", "missed m²", 0, "under passes, and left bare"),
    Figure("doubled_m2", "sum(doubled_m2)", "twice m²", 0, "treated twice, in one job"),
    Figure("changes", "sum(changes)", "changes", 0, "changes of rate whose lag was measured"),
    Figure("missed_changes", "sum(missed_changes)", "missed", 0, "changes that never happened"),
    Figure("apart_changes", "sum(apart_changes)", "apart", 0, "changes that cannot be measured"),
    Figure(
        "mean_lag_m",
        "sum(mean_lag_m * changes) / nullif(sum(changes) FILTER (mean_lag_m IS NOT NULL), 0)",
        "lag m",
        3,
        "mean of the absolute lag distances of all changes",
    ),
    Figure(
        "lag_trend_m_30_days",
        _TREND.format(value="mean_lag_m", days=_DAYS),
        "lag trend m/30 d",
        3,
        f"slope of the flights' mean lags; of {TREND_FLIGHTS_MIN} flights on two days or more",
    ),
    Figure(
        "flow_drift_percent",
        "sum(flow_drift_percent * modelled_l) / nullif(sum(modelled_l) FILTER "
        "(flow_drift_percent IS NOT NULL), 0)",
        "flow drift %",
        1,
        "meter against model, by litres: worn or blocked nozzles, or the meter",
    ),
    Figure(
        "flow_drift_trend_30_days",
        _TREND.format(value="flow_drift_percent", days=_DAYS),
        "drift trend %/30 d",
        2,
        "slope of the flights' flow drift",
    ),
    Figure(
        "faults",
        "sum(list_sum(list_transform(faults, lambda each: each.count)))",
        "faults",
        0,
        "findings of the fault detection",
    ),
    Figure(
        "closings",
        "sum(list_sum(list_transform(closings, lambda each: each.count)))",
        "closings",
        0,
        "reasons that closed open valves",
    ),
)
_SUMS = ", ".join(f"{each.sql} AS {each.name}" for each in FIGURES)
_TITLES = {
    "real": "Real flights",
    "unknown": "Flights not known to be real or simulated",
    "training": "Training with water, and dry",
    "simulated": "Simulated flights",
}


class Chosen(NamedTuple):
    """Which flights: months from and until, both included; kinds, all where there are none."""

    since: str | None = None
    until: str | None = None
    kinds: tuple[str, ...] = ()

    @property
    def sql(self) -> str:
        """Return the condition; ConfigError for what is no month and no kind."""
        parts = ["true"]
        for option, month, sign in (("--from", self.since, ">="), ("--until", self.until, "<=")):
            if month is not None:
                if not _MONTH.fullmatch(month):
                    raise ConfigError(f"{option} {month}: is not a month; write it as 2026-05")
                parts.append(f"month {sign} '{month}' AND month != 'unknown'")
        unknown = [kind for kind in self.kinds if kind not in KINDS]
        if unknown:
            raise ConfigError(f"--kind {unknown[0]}: no such kind; write one of {', '.join(KINDS)}")
        if self.kinds:
            parts.append(
                f"kind IN ({', '.join(f'{chr(39)}{kind}{chr(39)}' for kind in self.kinds)})"
            )
        return " AND ".join(parts)


def summary_of(fleet: Fleet, chosen: Chosen = Chosen()) -> dict[str, Any]:  # noqa: B008
    """Return the fleet's summary; real flights are never summed with others."""
    where = chosen.sql
    totals = _by_kind(fleet.rows(f"SELECT kind, {_SUMS} FROM flights WHERE {where} GROUP BY kind"))
    groups = {name: _grouped(fleet, name, where) for name in GROUPS}
    more = {
        "closings": fleet.rows(
            "SELECT kind, reason, sum(count) AS count, count(DISTINCT flight_id) AS flights, "
            f"sum(seconds) AS seconds FROM closings WHERE {where} GROUP BY kind, reason "
            "ORDER BY count DESC, reason"
        ),
        "faults": fleet.rows(
            "SELECT kind, fault, sum(count) AS count, count(DISTINCT flight_id) AS flights, "
            "count(DISTINCT coalesce(machine, '')) AS machines "
            f"FROM faults WHERE {where} GROUP BY kind, fault ORDER BY count DESC, fault"
        ),
        "valves": _valves(fleet, where),
    }
    sections = [
        {
            "kind": kind,
            "title": _TITLES[kind],
            "totals": totals[kind][0],
            "groups": {
                name: [row for row in rows if row["kind"] == kind] for name, rows in groups.items()
            },
            **{name: [row for row in rows if row["kind"] == kind] for name, rows in more.items()},
        }
        for kind in KINDS
        if kind in totals
    ]
    return {
        "fleet_version": SUMMARY_VERSION,
        "from": chosen.since,
        "until": chosen.until,
        "made_with": version("vrspray"),
        "sections": sections,
        "damaged": fleet.rows("SELECT journal, journal_sha256, problem FROM damaged ORDER BY ALL"),
    }


def _grouped(fleet: Fleet, name: str, where: str) -> Rows:
    order = "name" if name == "month" else "area_ha DESC NULLS LAST, name"
    return fleet.rows(
        f"SELECT kind, {_GROUPS[name]} AS name, {_SUMS} FROM flights WHERE {where} "
        f"GROUP BY kind, name ORDER BY kind, {order}"
    )


def _valves(fleet: Fleet, where: str) -> Rows:
    """Return of each machine's measured valves the first and the newest flow factor."""
    return fleet.rows(
        "SELECT kind, coalesce(machine, 'not named') AS machine, valve, "
        "arg_min(flow_factor, started_utc) AS first_factor, "
        "arg_max(flow_factor, started_utc) AS last_factor, "
        "100 * (last_factor / first_factor - 1) AS drift_percent, "
        "count(DISTINCT flow_factor) - 1 AS calibrations, "
        "strftime(max(started_utc), '%Y-%m-%d') AS last_day "
        f"FROM valves WHERE {where} GROUP BY kind, machine, valve "
        "HAVING max(abs(flow_factor - 1)) > 0 "
        "ORDER BY abs(drift_percent) DESC NULLS LAST, machine, valve"
    )


def _by_kind(rows: Sequence[dict[str, Any]]) -> dict[str, Rows]:
    found: dict[str, Rows] = {}
    for row in rows:
        found.setdefault(row["kind"], []).append(row)
    return found

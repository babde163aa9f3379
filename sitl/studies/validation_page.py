"""How the validation is shown: lines for a terminal, and a page."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from analysis.published import (
    P1_RATES_L_HA,
    P1_SPRAYING_ACCURACY_PERCENT,
    p1_accuracy_percent,
)
from companion.errors import ConfigError
from sitl.studies.validation_flights import (
    BOUND_M,
    BOUND_SPEED_M_S,
    BY_TABLE,
    EVERY_WAY,
    LOOK_AHEAD,
    WAYS,
    Row,
    Validation,
)

if TYPE_CHECKING:
    from analysis.published import P1LagDistance

COMMAND = "python -m sitl.studies.validation"
SET_CHANGE_L_MIN = 4.0
Table = list[tuple[str, ...]]

INTRODUCTION = """\
<!-- Written by `python -m sitl.studies.validation`; do not edit. -->

# Validation against Wang et al. 2024

The emulated controller of the paper (P1) and ours fly P1's field on the simulated sprayer, beside
P1's published figures; [accuracy](../explanation/accuracy.md) says what agrees and what does not.
"""

LAG_TEXT = """\
## Lag distance

*Settled*, as P1 measures it: from the boundary to where the total flow stays within 10 % of the
step at its new target; + is too late.
"""

OURS_TEXT = """\
Distance to the volume-equivalent step. More than a plot (12 m) is a failed measurement, left in.
"""

CLOSE_TEXT = """\
## What a look-ahead takes away
"""

ACCURACY_TEXT = """\
## Spraying accuracy by speed and rate

P1's Table 5 and the simulated sprayer: Eqs. 18 and 19 for each rate [L/ha], transitions included.
"""

EQ_2_TEXT = """\
### What P1's Eq. 2 explains of it

What is missing to 100 %, in points; *low* are the rates below 4 L/min, *high* the others.
"""

# What the two pictures show, for those who cannot see them.
PICTURES_SHOW = (
    "Settled lag distance of each method at 4, 5 and 6 m/s, with the ranges that P1 published",
    "Spraying accuracy by speed and prescribed rate: P1's Table 5, and the twin with each method",
)


def summary_lines(result: Validation) -> list[str]:
    """Return the tables for a terminal."""
    lines = [*_plain(_lag_table(result)), "", *_plain(_ours_table(result)), ""]
    lines += [*_plain(_accuracy_table(result)), "", *_plain(_eq_2_table(result)), ""]
    lines += [
        f"{method} at {BOUND_SPEED_M_S:g} m/s within {BOUND_M:g} m of P1: {'yes' if held else 'NO'}"
        for method, held in result.bounds().items()
    ]
    return [*lines, basis(result)]


def write_page(result: Validation, folder: Path, *, pictures: Sequence[str], command: str) -> None:
    """Write `validation.md` into a folder; `pictures` are paths from there.

    Raises:
        ConfigError: when it cannot be written.
    """
    path, today = folder / "validation.md", datetime.now(tz=UTC).date().isoformat()
    bounds = ", ".join(
        f"`{method}` {'met' if held else '**missed**'}" for method, held in result.bounds().items()
    )
    images = [
        f"![{alt}]({picture})\n" for alt, picture in zip(PICTURES_SHOW, pictures, strict=False)
    ]
    parts = [
        INTRODUCTION,
        f"Made by `{command}` on {today}: {basis(result)} Means at {BOUND_SPEED_M_S:g} m/s within "
        f"{BOUND_M:g} m of P1's: {bounds}.\n",
        LAG_TEXT,
        *images[:1],
        _markdown(_lag_table(result)),
        OURS_TEXT,
        _markdown(_ours_table(result)),
        CLOSE_TEXT,
        _markdown(_close_table(result)),
        ACCURACY_TEXT,
        *images[1:],
        _markdown(_accuracy_table(result)),
        EQ_2_TEXT,
        _markdown(_eq_2_table(result)),
    ]
    try:
        path.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None


def basis(result: Validation) -> str:
    """Return what the figures rest on."""
    flights = sum(row.flights for row in result.rows)
    seeds = result.seeds
    span = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    return f"{flights} flights, {span}, pulsed twin."


def _lag_table(result: Validation) -> Table:
    head = ("Speed", "Method", "Mean [m]", "Range [m]", "By rate [m]", "By flight [m]",
            "Changes", "Apart", "Missed", "P1 mean [m]", "P1 range [m]")  # fmt: skip
    return [head, *(_lag_row(row) for row in result.rows)]


def _lag_row(row: Row) -> tuple[str, ...]:
    lag, rates = row.settled, row.settled.rate_means_m
    seeds = lag.seed_means_m or (None, None)
    return (
        f"{row.speed_m_s:g} m/s",
        row.way.name,
        _metres(lag.all_m.mean),
        _range(lag.all_m.min, lag.all_m.max),
        _range(min(rates), max(rates)) if rates else "-",
        _range(*seeds),
        str(lag.all_m.count),
        str(lag.apart),
        str(lag.missed),
        *_published(row.published),
    )


def _published(row: P1LagDistance | None) -> tuple[str, str]:
    return ("-", "-") if row is None else (_metres(row.mean), _range(row.min, row.max))


def _ours_table(result: Validation) -> Table:
    head = ("Speed", "Method", "Mean [m]", "Mean of absolute values [m]", "Worst [m]",
            "Changes", "Apart", "Missed")  # fmt: skip
    rows = [
        (
            f"{row.speed_m_s:g} m/s",
            row.way.name,
            _metres(row.lag_distance_m.mean, places=3),
            _metres(row.lag_distance_m.mean_abs, places=3),
            _metres(row.lag_distance_m.max_abs),
            str(row.lag_distance_m.count),
            str(row.apart),
            str(row.missed),
        )
        for row in result.rows
    ]
    return [head, *rows]


def _close_table(result: Validation) -> Table:
    """Return what each look-ahead took away from the distance of `none`, and as time."""
    head = ("Speed", "`none`, as time [s]", "0.71 s takes away [m]", "as time [s]",
            "0.97 s takes away [m]", "as time [s]")  # fmt: skip
    table: Table = [head]
    for speed in result.speeds_m_s:
        means = [result.row(way, speed).settled.all_m.mean for way in WAYS[:3]]
        none, short, stated = (float("nan") if mean is None else mean for mean in means)
        cells = (none / speed, none - short, (none - short) / speed)
        more = (none - stated, (none - stated) / speed)
        table.append((f"{speed:g} m/s", *(f"{cell:.2f}" for cell in (*cells, *more))))
    return table


def _accuracy_table(result: Validation) -> Table:
    head = ("Method", "Speed", *(f"{rate:g}" for rate in P1_RATES_L_HA), "All", "By flight")
    table: Table = [head]
    for speed, published in P1_SPRAYING_ACCURACY_PERCENT.items():
        mean = p1_accuracy_percent(speed)
        table.append(("P1, Table 5", f"{speed:g} m/s", *_cells(published), *_cells([mean]), "-"))
    for way in EVERY_WAY:
        for row in (row for row in result.rows if row.way == way):
            cells = row.cells_percent()
            low, high = row.seed_accuracy_percent
            ends = (*_cells([mean_of(cells)]), f"{low:.2f} to {high:.2f}")
            table.append((way.name, f"{row.speed_m_s:g} m/s", *_cells(cells), *ends))
    return table


def _eq_2_table(result: Validation) -> Table:
    """Return what is lost of the accuracy: by P1, with its table, with its law."""
    head = ("Speed", "Who", "Loss, all [points]", "low rates", "high rates")
    table: Table = [head]
    for speed, published in P1_SPRAYING_ACCURACY_PERCENT.items():
        flown = {row.way for row in result.rows if row.speed_m_s == speed}
        if not {BY_TABLE, LOOK_AHEAD} <= flown:
            continue
        lines: dict[str, Sequence[float | None]] = {"P1": published}
        for way in (BY_TABLE, LOOK_AHEAD):
            lines[way.name] = result.row(way, speed).cells_percent()
        # 60 B V / 10 000 of P1's Eq. 1, with B = 6 m.
        low = [rate * 0.036 * speed < SET_CHANGE_L_MIN for rate in P1_RATES_L_HA]
        for who, cells in lines.items():
            parts = (
                cells,
                [cell for cell, is_low in zip(cells, low, strict=True) if is_low],
                [cell for cell, is_low in zip(cells, low, strict=True) if not is_low],
            )
            lost = [_lost(mean_of(part)) for part in parts]
            table.append((f"{speed:g} m/s", who, *lost))
    return table


def _lost(percent: float | None) -> str:
    return "-" if percent is None else f"{100.0 - percent:.2f}"


def mean_of(cells: Sequence[float | None]) -> float | None:
    """Return the plain mean of cells, as P1's; None without any."""
    known = [cell for cell in cells if cell is not None]
    return fmean(known) if known else None


def _cells(values: Sequence[float | None]) -> tuple[str, ...]:
    return tuple("-" if value is None else f"{value:.2f}" for value in values)


def _metres(value_m: float | None, *, places: int = 2) -> str:
    return "-" if value_m is None else f"{value_m:.{places}f}"


def _range(low_m: float | None, high_m: float | None) -> str:
    return "-" if low_m is None or high_m is None else f"{low_m:.2f} to {high_m:.2f}"


def _plain(table: Table) -> list[str]:
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in table
    ]


def _markdown(table: Table) -> str:
    rows = [table[0], ("---", "---", *("---:" for _ in table[0][2:])), *table[1:]]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"

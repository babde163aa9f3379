"""The sheet a pilot flies by, to print: what to fill, when to take off, how far, how long.

One table, a row for each sortie, as HTML for the printer or as plain text.
"""

from __future__ import annotations

import base64
import math
import re
from dataclasses import dataclass
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

from companion.config import Config
from missions.errors import PlanError
from missions.maps.model import write_whole
from missions.mix import amount_words, product_words, rinse_words, scale_of
from missions.plan import Plan

SUFFIXES = (".html", ".txt")
PICTURES = {".png": "image/png", ".svg": "image/svg+xml"}
_DAY_MIN = 24 * 60
# The columns that are read from a distance.
_LARGE = ("fill to\nL", "water up to\nL")
_STYLE = """@page { size: A4 landscape; margin: 10mm; }
body { font: 10pt sans-serif; margin: 8mm; color: #000; }
h1 { font-size: 16pt; margin: 0 0 2mm; }
ul { margin: 0 0 4mm; padding: 0; list-style: none; columns: 2; }
li { break-inside: avoid; padding-left: 34mm; text-indent: -34mm; }
li b { display: inline-block; min-width: 34mm; text-indent: 0; }
table { border-collapse: collapse; width: 100%; margin-bottom: 4mm; }
th, td { border: 0.2mm solid #777; padding: 0.8mm 1.5mm; text-align: right; }
th { background: #eee; font-size: 8.5pt; }
thead { display: table-header-group; }
tr { break-inside: avoid; }
tfoot td { font-weight: bold; }
td.fill { font-size: 13pt; font-weight: bold; }
p { margin: 3mm 0 0; }
img { max-width: 100%; max-height: 180mm; margin-top: 4mm; break-inside: avoid; }"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Product:
    """What is in the tank; `per_l` is product in one litre of it."""

    name: str | None = None
    registration: str | None = None
    per_l: float | None = None
    unit: str = "L"

    @property
    def words(self) -> str | None:
        """Return its name with its registration; None where no name is known."""
        if self.name is None:
            return None
        return self.name if self.registration is None else f"{self.name} ({self.registration})"


NO_PRODUCT = Product()


def product_of(config: Config | None) -> Product:
    """Return what the configuration says of the product."""
    if config is None:
        return NO_PRODUCT
    table, said = config.product, config.told()
    return Product(
        name=table.name,
        registration=table.registration,
        per_l=said.get("application.product_per_l"),
        unit=said.get("application.product_unit", "L"),
    )


def field_name(config: Config | None) -> str | None:
    """Return what the farm calls the field; None where the configuration does not say."""
    return None if config is None else config.application.field_name


def check_sheet(out: Path) -> None:
    """Refuse a sheet whose suffix names no format, before any work."""
    if out.suffix.casefold() not in SUFFIXES:
        raise PlanError(f"--sheet {out}: sheets are written as {', '.join(SUFFIXES)}")


def parse_start(text: str | None) -> int | None:
    """Return minutes after midnight of a time of day as it is typed.

    >>> parse_start("07:30"), parse_start(None)
    (450, None)
    """
    if text is None:
        return None
    found = re.fullmatch(r"([01]?\d|2[0-3]):([0-5]\d)", text.strip(), flags=re.ASCII)
    if found is None:
        raise PlanError(f"--start {text!r:.40}: write the time of the first take-off, such as 7:30")
    return int(found[1]) * 60 + int(found[2])


def clock(seconds: float, start_min: int | None = None) -> str:
    """Return a time to the nearest minute: of the day, or since the first take-off.

    >>> clock(4000.0), clock(4000.0, 450), clock(120.0, 23 * 60 + 59)
    ('1:07', '08:37', '00:01 +1 d')
    """
    minutes = math.floor(seconds / 60.0 + 0.5)
    if start_min is None:
        return f"{minutes // 60}:{minutes % 60:02}"
    days, minutes = divmod(minutes + start_min, _DAY_MIN)
    return f"{minutes // 60:02}:{minutes % 60:02}" + (f" +{days} d" if days else "")


def write_sheet(
    plan: Plan,
    found: dict[str, Any],
    out: Path,
    *,
    title: str,
    product: Product = NO_PRODUCT,
    start_min: int | None = None,
    picture: Path | None = None,
) -> None:
    """Write the sheet of a plan, with the figures of `missions.sheet`; HTML holds its picture."""
    check_sheet(out)
    planned = ("Planned", f"{datetime.now().astimezone():%Y-%m-%d %H:%M}")
    facts = [planned, *_facts(plan, found, product)]
    tables = [_table(plan, found, product, start_min)]
    notes = _notes(plan, start_min)
    if found.get("mix") is not None:
        tables.append(_mix_table(found["mix"]))
        notes = [*_mix_notes(found["mix"]), *notes]
    if out.suffix.casefold() == ".html":
        text = _html(title, facts, tables, notes, _shown(picture))
    else:
        text = _text(title, facts, tables, notes)
    write_whole(out, text.encode("utf-8"))


Facts = list[tuple[str, str]]
Table = list[list[str]]


def _facts(plan: Plan, found: dict[str, Any], product: Product) -> Facts:
    """Return what holds for all sorties."""
    settings, rows = plan.settings, found["sorties"]
    adds_l, needs_l = (sum(row[name] for row in rows) for name in ("add_l", "needs_l"))
    facts = [
        ("Field", f"{found['coverage_percent']:.2f} % covered of {ground_text(found)}"),
        ("To mix", f"{adds_l:.1f} L: {needs_l:.1f} L to spray, the rest is reserve"),
    ]
    if settings.in_tank_l > 0.0:
        text = f"{adds_l:.1f} L, beside the {settings.in_tank_l:g} L that are in the tank"
        facts[1] = ("To mix", f"{text}; {needs_l:.1f} L to spray, the rest is reserve")
    mix = found.get("mix")
    if mix is not None:
        facts += [
            (
                f"Product {number}",
                f"{product_words(each)}: {amount_words(each['total'], each['measure'])} in all, "
                f"{amount_words(each['leftover'], each['measure'])} of it in what is left",
            )
            for number, each in enumerate(mix["products"], start=1)
        ]  # fmt: skip
        facts += [
            ("Water", f"{mix['water_l']:.1f} L; solids take the place of some"),
            ("Left over", f"{mix['leftover_l']:.2f} L of the mix"),
            ("Rinse", rinse_words(mix["rinse"])),
        ]
    elif product.words is not None:
        facts.append(("Product", product.words))
    if mix is None and product.per_l is not None:
        facts.append(("Dose", f"{adds_l * product.per_l:.2f} {product.unit} of it in that mix"))
    facts += [
        ("Time", f"{clock(found['total_s'])} (h:min) from first take-off to last landing"),
        ("Refill", f"{settings.refill_s:g} s, fresh battery {settings.swap_s:g} s; the clock "
         "counts both"),
        ("Speed, height", f"{_speeds(rows)} m/s, {settings.height_m:g} m above "
         f"{'the ground' if plan.terrain is not None else 'the depot'}{_ferries(plan)}"),
        ("Swath", f"{settings.swath_width_m:g} m, course {plan.angle_deg:.0f} deg"),
        ("Way", _way(found)),
        ("Wind", _wind(plan)),
    ]  # fmt: skip
    for number, (latitude_deg, longitude_deg) in enumerate(found["depots"], start=1):
        name = "Depot" if len(found["depots"]) == 1 else f"Depot {number}"
        suggested = " (suggested)" if plan.suggested_depot else ""
        facts.append((name, f"{latitude_deg:.6f}, {longitude_deg:.6f}{suggested}"))
    return facts


def _ferries(plan: Plan) -> str:
    height_m = plan.settings.ferry_height_m
    return "" if height_m is None else f", ferries {height_m:g} m"


def _way(found: dict[str, Any]) -> str:
    """Return what is flown along passes and beside them, and how little that could be."""
    beside_m = found["transit_m"] + found["ferry_m"]
    text = f"{found['spray_m'] / 1e3:.1f} km of passes, {beside_m / 1e3:.1f} km of other ways"
    least_m = found["least_idle_m"]
    return text if least_m < 50.0 else f"{text} (in any order {least_m / 1e3:.1f} km or more)"


def _wind(plan: Plan) -> str:
    if plan.wind is None:
        return "not given; measure it before take-off"
    return f"planned for {plan.wind[0]:g} m/s from {plan.wind[1]:g} deg"


def _speeds(rows: list[dict[str, Any]]) -> str:
    low = min(row["speeds_m_s"][0] for row in rows)
    high = max(row["speeds_m_s"][1] for row in rows)
    return f"{high:g}" if low == high else f"{low:g} to {high:g}"


def _table(plan: Plan, found: dict[str, Any], product: Product, start_min: int | None) -> Table:
    """Return the head, a row for each sortie, and the sums; columns without a word are left out."""
    rows = found["sorties"]
    columns: list[tuple[str, list[str], str]] = [
        ("sortie", [str(row["number"]) for row in rows], "all"),
        ("fill to\nL", [f"{row['fill_l']:.1f}" for row in rows], ""),
        ("new in it\nL", [f"{row['add_l']:.1f}" for row in rows], _sum(rows, "add_l", 1)),
    ]
    if found.get("mix") is None and product.per_l is not None:
        doses = [row["add_l"] * product.per_l for row in rows]
        columns.append(
            (f"product\n{product.unit}", [f"{dose:.2f}" for dose in doses], f"{sum(doses):.2f}")
        )
    columns += [
        ("take-off", [clock(row["start_s"], start_min) for row in rows], ""),
        ("landing", [clock(row["land_s"], start_min) for row in rows], ""),
        ("in the air\nmin", [f"{row['airborne_s'] / 60:.1f}" for row in rows],
         f"{sum(row['airborne_s'] for row in rows) / 60:.1f}"),
        ("passes", [str(row["swaths"]) for row in rows], _sum(rows, "swaths", 0)),
        ("spray\nL", [f"{row['needs_l']:.1f}" for row in rows], _sum(rows, "needs_l", 1)),
        ("sprayed twice\nL", [f"{row['overlap_l']:.2f}" for row in rows],
         _sum(rows, "overlap_l", 2)),
        ("farthest\nm", [f"{row['farthest_m']:.0f}" for row in rows],
         f"{max(row['farthest_m'] for row in rows):.0f}"),
    ]  # fmt: skip
    if rows[0]["energy_wh"] is not None:
        columns.append(
            ("Wh", [f"{row['energy_wh']:.0f}" for row in rows], _sum(rows, "energy_wh", 0))
        )
    if rows[0]["battery_percent"] is not None:
        columns += [
            ("of battery\n%", [f"{row['battery_percent']:.0f}" for row in rows], ""),
            ("left at landing\n%", [f"{row['battery_left_percent']:.0f}" for row in rows], ""),
            ("battery", ["fresh" if row["swap"] or row["first"] else "stays" for row in rows], ""),
        ]
    if len(found["depots"]) > 1:
        columns.insert(1, ("depot", [str(each.depot + 1) for each in plan.sorties], ""))
    if plan.settings.aircraft > 1:
        columns.insert(1, ("aircraft", [str(row["aircraft"]) for row in rows], ""))
    head, cells, sums = zip(*columns, strict=True)
    return [list(head), *(list(row) for row in zip(*cells, strict=True)), list(sums)]


def _mix_table(mix: dict[str, Any]) -> Table:
    """Return what is poured before each sortie, in this order, and the sums."""
    rows, products = mix["sorties"], mix["products"]
    columns = [
        ("mix for\nsortie", [str(row["number"]) for row in rows], "all"),
        ("water first\nL", [f"{row['water_first_l']:.2f}" for row in rows], ""),
    ]
    for at, each in enumerate(products):
        amounts = [row["amounts"][at] for row in rows]
        unit, factor, digits = scale_of(max(amounts), each["measure"])
        shown = [f"{amount * factor:.{digits}f}" for amount in (*amounts, each["total"])]
        columns.append((f"{at + 1}. {each['name']}\n{unit}", shown[:-1], shown[-1]))
    columns.append(
        ("water up to\nL", [f"{row['mix_l']:.2f}" for row in rows], f"{mix['mix_l']:.2f}")
    )
    head, cells, sums = zip(*columns, strict=True)
    return [list(head), *(list(row) for row in zip(*cells, strict=True)), list(sums)]


def _mix_notes(mix: dict[str, Any]) -> list[str]:
    return [
        "Mix: half of the water, then the products from left to right, each well stirred in before "
        "the next, then water up to the last figure. The labels come first. Try a mix that is new "
        "to you in a jar.",
        *mix["notes"],
    ]


def _sum(rows: list[dict[str, Any]], name: str, digits: int) -> str:
    return f"{sum(row[name] for row in rows):.{digits}f}"


def _notes(plan: Plan, start_min: int | None) -> list[str]:
    since = "" if start_min is not None else " Times count from the first take-off."
    notes = [
        "Fill to: what is in the tank at take-off, the reserve in it. New in it: what is poured "
        f"in; the reserve of the last sortie is still there.{since}"
    ]
    for sortie in plan.sorties:
        if sortie.after:
            numbers = " and ".join(str(number) for number in sortie.after)
            notes.append(f"Sortie {sortie.number}: not before sortie {numbers} has landed.")
    return [*notes, *plan.warnings]


def _text(title: str, facts: Facts, tables: list[Table], notes: list[str]) -> str:
    """Return the sheet in plain text; units stand below the heads."""
    lines = [title, "=" * len(title), ""]
    lines += [f"{name:<14} {value}" for name, value in facts]
    for table in tables:
        lines += ["", *_text_table(table)]
    lines += ["", *notes]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _text_table(table: Table) -> list[str]:
    heads = [head.split("\n") for head in table[0]]
    high = max(len(head) for head in heads)
    rows = [
        [head[number] if number < len(head) else "" for head in heads] for number in range(high)
    ]
    body, sums = table[1:-1], table[-1]
    widths = [max(map(len, column)) for column in zip(*rows, *body, sums, strict=True)]
    rule = "  ".join("-" * width for width in widths)
    lines = [*(_row(row, widths) for row in rows), rule]
    return [*lines, *(_row(row, widths) for row in body), rule, _row(sums, widths)]


def _row(cells: list[str], widths: list[int]) -> str:
    return "  ".join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True))


def _shown(picture: Path | None) -> list[str]:
    """Return a picture inside the page; none of a format that browsers do not show there."""
    kind = None if picture is None else PICTURES.get(picture.suffix.casefold())
    if picture is None or kind is None:
        return []
    content = base64.b64encode(picture.read_bytes()).decode("ascii")
    return [f'<img alt="plan" src="data:{kind};base64,{content}">']


def _html(
    title: str, facts: Facts, tables: list[Table], notes: list[str], picture: list[str]
) -> str:
    """Return the sheet as a page of its own, without a script and without a file beside it."""
    lines = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        "<ul>",
        *(f"<li><b>{escape(name)}</b> {escape(value)}</li>" for name, value in facts),
        "</ul>",
        *(line for table in tables for line in _html_table(table)),
        *(f"<p>{escape(note)}</p>" for note in notes),
        *picture,
        "</body></html>",
    ]
    return "\n".join(lines) + "\n"


def _html_table(table: Table) -> list[str]:
    head = "".join(f"<th>{escape(name).replace(chr(10), '<br>')}</th>" for name in table[0])
    fill = next(at for at, name in enumerate(table[0]) if name in _LARGE)
    body = "\n".join(f"<tr>{_cells(row, fill)}</tr>" for row in table[1:-1])
    return [
        f"<table><thead><tr>{head}</tr></thead>",
        f"<tbody>{body}</tbody>",
        f"<tfoot><tr>{_cells(table[-1])}</tr></tfoot></table>",
    ]


def _cells(row: list[str], fill: int | None = None) -> str:
    return "".join(
        f'<td class="fill">{escape(cell)}</td>' if at == fill else f"<td>{escape(cell)}</td>"
        for at, cell in enumerate(row)
    )


def ground_text(found: dict[str, Any]) -> str:
    """Return the ground that is to be covered; what has no rate is none of it.

    >>> ground_text({"area_ha": 2.0, "without_rate_ha": 0.5})
    '1.50 ha (another 0.50 ha have no rate)'
    >>> ground_text({"area_ha": 2.0, "without_rate_ha": 0.0})
    '2.00 ha'
    """
    bare_ha = found["without_rate_ha"]
    text = f"{found['area_ha'] - bare_ha:.2f} ha"
    return text if bare_ha == 0.0 else f"{text} (another {bare_ha:.2f} ha have no rate)"

"""All cards of one run, and how they stand in JSON, CSV and text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from analysis.wsp.card import (
    FUNGICIDE_PER_CM2,
    INSECTICIDE_PER_CM2,
    OVERSPRAY_PERCENT,
    Card,
    Method,
    SheetResult,
)
from analysis.wsp.stains import LAW, LEAST_DROP_UM, UNRELIABLE_PERCENT, second_of
from companion.csv_table import csv_of

# Columns of a card's figures, in the order of CSV; those of the second spread factor follow.
SIZES = (
    "deposits",
    "deposits_per_cm2",
    "coverage_percent",
    "dv01_um",
    "dv05_um",
    "dv09_um",
    "relative_span",
    "nmd_um",
    "ul_per_cm2",
    "l_ha",
)
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbered:
    """A card with its number in the run, and the names that a table of positions may give it."""

    number: int
    names: tuple[str, ...]
    sheet: SheetResult
    card: Card


def numbered(sheets: Sequence[SheetResult]) -> list[Numbered]:
    """Return all cards, numbered over all sheets from 1.

    A card is also called by its file and its place there, `scan-2`, and by the file alone where
    that has a single card.
    """
    per_file: dict[str, int] = {}
    for sheet in sheets:
        per_file[sheet.path.stem] = per_file.get(sheet.path.stem, 0) + len(sheet.cards)
    found: list[Numbered] = []
    seen: dict[str, int] = {}
    for sheet in sheets:
        stem = sheet.path.stem
        for card in sheet.cards:
            seen[stem] = seen.get(stem, 0) + 1
            number = len(found) + 1
            names: tuple[str, ...] = (str(number), f"{stem}-{seen[stem]}")
            if per_file[stem] == 1:
                names = (*names, stem)
            found.append(Numbered(number=number, names=names, sheet=sheet, card=card))
    return found


def density_class(per_cm2: float) -> str:
    """Return where a density stands between P1's limits.

    >>> density_class(46.5)
    '30 to 70'
    """
    if per_cm2 < INSECTICIDE_PER_CM2:
        return f"below {INSECTICIDE_PER_CM2:g}"
    if per_cm2 <= FUNGICIDE_PER_CM2:
        return f"{INSECTICIDE_PER_CM2:g} to {FUNGICIDE_PER_CM2:g}"
    return f"above {FUNGICIDE_PER_CM2:g}"


def card_row(each: Numbered) -> Row:
    """Return one card as JSON has it."""
    card = each.card
    main, second = asdict(card.main), asdict(card.second)
    return {
        "card": each.number,
        "name": each.names[-1],
        "file": str(each.sheet.path),
        "page": each.sheet.page,
        "outline_px": [[round(float(v), 1) for v in corner] for corner in card.outline.corners],
        "angle_deg": round(card.outline.angle_deg, 2),
        "width_mm": card.width_mm,
        "length_mm": card.length_mm,
        "roi_cm2": card.roi_cm2,
        "dpi": card.dpi,
        "dpi_source": each.sheet.dpi_source,
        "threshold": card.threshold,
        "spread": main["spread"],
        **{key: main[key] for key in SIZES},
        "stain_percent": card.stain_percent,
        "density_class": density_class(card.main.deposits_per_cm2),
        "covered_percent": card.better.covered_percent,
        "drops_per_cm2": card.better.drops_per_cm2,
        "merged_percent": card.better.merged_percent,
        "midway_threshold": card.better.threshold,
        "second": {"spread": second["spread"]} | {key: second[key] for key in SIZES},
        "flags": dict(card.flags),
    }


def method_row(method: Method) -> Row:
    """Return what all figures rest on."""
    second = second_of(method.spread)
    return {
        "grey": "round((R + G + B) / 3)",
        "threshold": method.threshold,
        "neighbours": 8,
        "least_drop_um": LEAST_DROP_UM,
        "spread": method.spread.name,
        "spread_formula": method.spread.formula,
        "second_spread": second.name,
        "second_formula": second.formula,
        "inset_mm": method.inset_mm,
        "overlap_law": LAW,
        "limits": {
            "overspray_percent": OVERSPRAY_PERCENT,
            "counts_unreliable_percent": UNRELIABLE_PERCENT,
            "insecticide_per_cm2": INSECTICIDE_PER_CM2,
            "fungicide_per_cm2": FUNGICIDE_PER_CM2,
        },
    }


def summary(cards: Sequence[Numbered]) -> Row | None:
    """Return the figures that P1 gives of all its cards; None without a card."""
    if not cards:
        return None
    coverage = np.array([each.card.main.coverage_percent for each in cards])
    density = np.array([each.card.main.deposits_per_cm2 for each in cards])
    within = (density >= INSECTICIDE_PER_CM2) & (density <= FUNGICIDE_PER_CM2)
    return {
        "cards": len(cards),
        "coverage_percent": _spread(coverage),
        "deposits_per_cm2": _spread(density),
        "between_limits_percent": 100.0 * float(within.mean()),
        "overspray_cards": int((coverage > OVERSPRAY_PERCENT).sum()),
    }


def _spread(values: np.ndarray) -> Row:
    return {
        "mean": float(values.mean()),
        "sd": float(values.std(ddof=1)) if len(values) > 1 else None,
        "least": float(values.min()),
        "most": float(values.max()),
    }


def sheet_row(sheet: SheetResult, cards: Sequence[Numbered], picture: str | None) -> Row:
    """Return one sheet as JSON has it."""
    return {
        "file": str(sheet.path),
        "page": sheet.page,
        "width_px": sheet.width_px,
        "height_px": sheet.height_px,
        "dpi": sheet.dpi,
        "dpi_source": sheet.dpi_source,
        "cards": [each.number for each in cards if each.sheet is sheet],
        "picture": picture,
        "notes": list(sheet.notes),
    }


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the cards as a table, a row a card; what is not known is blank."""
    return csv_of([_flat(row) for row in rows])


def _flat(row: Mapping[str, Any]) -> Row:
    flat: Row = {}
    for key, value in row.items():
        if key == "flags":
            flat[key] = " ".join(value)
        elif key == "outline_px":
            continue
        elif isinstance(value, Mapping):
            flat.update({f"{key}_{name}": _cell(item) for name, item in value.items()})
        else:
            flat[key] = _cell(value)
    return flat


def _cell(value: Any) -> Any:
    return round(value, 7) if isinstance(value, float) else value


def table_lines(cards: Sequence[Numbered], method: Method) -> Iterator[str]:
    """Yield the table for a person, figures of both spread factors side by side."""
    if not cards:
        yield "no card was found"
        return
    main, second = method.spread.name, second_of(method.spread).name
    yield f"drop sizes by {main} ({method.spread.formula}) / {second}"
    yield (
        "card  cover*  drops*   cover  depos.      Dv0.1      Dv0.5      Dv0.9    span         L/ha"
        "  where, flags"
    )
    yield "           %    /cm2       %    /cm2         um         um         um"
    for each in cards:
        yield _line(each)
    yield (
        "* use these: corrected for threshold, blur and overlap of drops that fell evenly "
        f"({LAW}); cover and deposits without it: as Wang et al. 2024 count stains"
    )


def _line(each: Numbered) -> str:
    card = each.card
    main, second = card.main, card.second
    pairs = [
        (getattr(main, name), getattr(second, name)) for name in ("dv01_um", "dv05_um", "dv09_um")
    ]
    sizes_text = " ".join(f"{_number(a, 0):>6}/{_number(b, 0):<3}" for a, b in pairs)
    span = f"{_number(main.relative_span, 2):>5}"
    volume = f"{main.l_ha:6.2f}/{second.l_ha:.2f}"
    flags = ", ".join(card.flags)
    return (
        f"{each.number:4d}  {card.better.covered_percent:6.2f}  "
        f"{_number(card.better.drops_per_cm2, 1):>6}  "
        f"{main.coverage_percent:6.2f}  {main.deposits_per_cm2:6.1f} "
        f"{sizes_text}  {span} {volume:>12}  "
        f"{each.sheet.name}{': ' + flags if flags else ''}"
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"

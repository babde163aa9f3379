"""Figures of water-sensitive paper: `python -m tests.bench.wsp [SHEETS] [--seed N]`.

Twenty A4 scans of ten synthetic cards each, 600 dpi, every third as PNG, TIFF and JPEG; half of the
cards at 0.5 to 5 % coverage, half at 5 to 15 %. Drops are log-normal, median of the volume 150 to
400 um, sigma 1.3 to 1.7. Colours, texture, noise and blur of the scanner are drawn for each sheet.
Cards are found, and the truth is that of the region that was measured: all drops above 50 um with
their middles in it, and all ground under stains of drops of any size.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from analysis.wsp.card import INSET_MM, Card, Method, Reading, SheetResult, read_sheet
from analysis.wsp.image import sheets_of
from analysis.wsp.stains import LEAST_DROP_UM
from tests.synthetic_cards import Scanner, Spray, TrueSheet, a4_places, draw_sheet, save

CARDS = 10
ENDINGS = ("png", "tif", "jpg")
# Coverage [%] below which a figure must hold, and by how much the count may be off.
CLASSES = ((0.0, 5.0, 3.0), (5.0, 15.0, 6.0))
COVERAGE_POINTS = 0.5
NOTE = "coverage, deposits: DepositScan's chain; covered, drops: corrected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """One card against its truth; differences in points and in percent of the truth."""

    coverage_percent: float
    drops: int
    nmd_um: float
    sigma: float
    coverage_points: float
    covered_points: float
    deposits_off: float
    drops_off: float
    dv05_off: float
    volume_off: float
    corner_mm: float


def sprays(rng: np.random.Generator) -> list[Spray]:
    """Return what falls on the cards of a sheet: by coverage wanted, and sizes."""
    found = []
    for number in range(CARDS):
        low, high, _ = CLASSES[number % 2]
        coverage = rng.uniform(max(low, 0.5), high) / 100.0
        vmd_um, sigma = rng.uniform(150.0, 400.0), rng.uniform(1.3, 1.7)
        nmd_um = vmd_um * math.exp(-3.0 * math.log(sigma) ** 2)
        # Mean area of a stain d = (D / 0.95)^(1 / 0.91) over the log-normal sizes.
        power = 2.0 / 0.91
        mean_um2 = math.pi / 4.0 * (nmd_um / 0.95) ** power
        mean_um2 *= math.exp(0.5 * (power * math.log(sigma)) ** 2)
        per_um2 = -math.log(1.0 - coverage) / mean_um2
        found.append(Spray(drops_per_cm2=per_um2 * 1e8, nmd_um=nmd_um, sigma=sigma))
    return found


def scanner(rng: np.random.Generator) -> Scanner:
    """Return a scanner drawn at random around the usual one."""
    usual = Scanner()
    shift = rng.uniform(-12.0, 12.0, 2)
    return replace(
        usual,
        paper=tuple(np.array(usual.paper) + shift[0]),
        stain=tuple(np.array(usual.stain) + shift[1]),
        texture=float(rng.uniform(1.0, 5.0)),
        noise=float(rng.uniform(0.5, 4.0)),
        blur_px=float(rng.uniform(0.4, 0.8)),
    )


def measured(number: int, seed: int, folder: Path) -> tuple[list[Found], dict[str, float]]:
    """Return the cards of one sheet against their truth, and the seconds it took."""
    rng = np.random.default_rng([seed, number])
    size, places = a4_places(CARDS, seed=int(rng.integers(1 << 30)))
    falling = sprays(rng)
    truth = draw_sheet(
        falling, places, size=size, seed=int(rng.integers(1 << 30)), scanner=scanner(rng)
    )
    path = folder / f"sheet.{ENDINGS[number % len(ENDINGS)]}"
    save(truth, path)
    start = time.process_time()
    (sheet,) = sheets_of(path)
    read = time.process_time()
    result = read_sheet(sheet, Reading(method=Method()))
    done = time.process_time()
    if len(result.cards) != CARDS:
        raise SystemExit(f"sheet {number}: {len(result.cards)} cards found of {CARDS}")
    seconds = {f"read {path.suffix}": read - start, "analyse": done - read}
    return list(_against(truth, result, falling)), seconds


def _against(truth: TrueSheet, result: SheetResult, falling: list[Spray]) -> Iterator[Found]:
    for card, true, spray in zip(result.cards, truth.cards, falling, strict=True):
        region = card.outline.inset(INSET_MM * card.dpi / 25.4)
        coverage, count = truth.coverage_percent(region), true.count(region)
        drop_um = np.sort(true.drop_um[true.inside(region) & (true.drop_um > LEAST_DROP_UM)])
        volume = np.cumsum(drop_um**3)
        dv05_um = float(np.interp(0.5, volume / volume[-1], drop_um))
        l_ha = math.pi / 6.0 * float(volume[-1]) * 1e-7 / card.roi_cm2
        per_cm2 = count / card.roi_cm2
        yield Found(
            coverage_percent=coverage,
            drops=count,
            nmd_um=spray.nmd_um,
            sigma=spray.sigma,
            coverage_points=card.main.coverage_percent - coverage,
            covered_points=card.better.covered_percent - coverage,
            deposits_off=_off(card.main.deposits_per_cm2, per_cm2),
            drops_off=_off(card.better.drops_per_cm2, per_cm2),
            dv05_off=_off(card.main.dv05_um, dv05_um),
            volume_off=_off(card.main.l_ha, l_ha),
            corner_mm=_corner_mm(card, true.outline.corners),
        )


def _off(value: float | None, truth: float) -> float:
    return math.nan if value is None else 100.0 * (value / truth - 1.0)


def _corner_mm(card: Card, corners: np.ndarray) -> float:
    between = np.hypot(*(card.outline.corners[:, None] - corners[None]).transpose(2, 0, 1))
    return float(between.min(axis=1).max()) * 25.4 / card.dpi


def table(found: list[Found]) -> Iterator[str]:
    """Yield the figures of each class of coverage."""
    yield NOTE
    for low, high, limit in CLASSES:
        cards = [each for each in found if low <= each.coverage_percent < high]
        if not cards:
            continue
        counts = [each.drops for each in cards]
        yield (
            f"{low:g} to {high:g} % coverage: {len(cards)} cards, {min(counts)} to {max(counts)} "
            "drops above 50 um"
        )
        yield f"{'':26s}{'mean':>8s}{'sd':>8s}{'worst':>8s}   within"
        for name, unit, within in (
            ("coverage_points", "points", COVERAGE_POINTS),
            ("covered_points", "points", COVERAGE_POINTS),
            ("deposits_off", "%", limit),
            ("drops_off", "%", limit),
            ("dv05_off", "%", None),
            ("volume_off", "%", None),
        ):
            values = np.array([getattr(each, name) for each in cards])
            yield _line(f"{name} [{unit}]", values, within)
    corners = max(each.corner_mm for each in found)
    yield f"corners of the cards found to {corners:.2f} mm at worst of {len(found)} cards"


def _line(name: str, values: np.ndarray, within: float | None) -> str:
    share = ""
    if within is not None:
        inside = int((np.abs(values) <= within).sum())
        share = f"   {inside} of {len(values)} within {within:g}"
    worst = values[np.argmax(np.abs(values))]
    return f"  {name:24s}{values.mean():+8.2f}{values.std():8.2f}{worst:+8.2f}{share}"


def worst(found: list[Found]) -> Iterator[str]:
    """Yield the cards whose count is off by more than its limit."""
    for low, high, limit in CLASSES:
        for each in found:
            if low <= each.coverage_percent < high and not abs(each.drops_off) <= limit:
                yield (
                    f"  beyond: coverage {each.coverage_percent:.2f} %, {each.drops} drops, "
                    f"{each.nmd_um:.0f} um, sigma {each.sigma:.2f}, {each.drops_off:+.2f} %"
                )


def main() -> None:
    """Draw, measure, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sheets", nargs="?", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found: list[Found] = []
    seconds: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.sheets):
            cards, took = measured(number, options.seed, Path(folder))
            found.extend(cards)
            for name, value in took.items():
                seconds.setdefault(name, []).append(value)
    lines = [*table(found), *worst(found)]
    for name, values in sorted(seconds.items()):
        lines.append(f"{name}: {np.mean(values):.2f} s of processor, {max(values):.2f} at worst")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

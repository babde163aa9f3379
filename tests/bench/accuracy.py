"""From many flights to the figures of accuracy: means over the seeds, and the worst seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.bench.figures import Figure
from tests.bench.flight_group import (
    Group,
    below_perfect,
    is_settled,
    least_of,
    mean_of,
    most_of,
    weighted,
    weighted_perfect,
    worst_seed,
)
from tests.bench.flights import PAPER_M_S, PAPER_METHODS, Flown
from tests.bench.sprayers import OUTPUTS

# Mean and greatest lag distance in metres up to 6 m/s, by output; beyond it in seconds of flight.
TARGETS_M = {"gpio": (0.05, 0.20), "servo": (0.05, 0.20), "free-running": (0.15, 0.40)}
FAST_FROM_M_S = 6.5
FAST_TARGET_S = 0.015
NONE_RATIO_MIN = 3.0
# What a plant that the controller did not know may be off, when it has been identified.
UNKNOWN_FACTOR = 2.0


def accuracy(flown: Sequence[Flown], *, section: str, factor: float = 1.0) -> list[Figure]:
    """Return the figures of all kinds of flights among these, and of the paper's methods.

    `factor` is what the targets of lag distance are multiplied by.
    """
    figures: list[Figure] = []
    kinds = sorted({(f.plant, f.condition, f.lags, f.speed_m_s) for f in flown})
    for kind in kinds:
        alike = [f for f in flown if (f.plant, f.condition, f.lags, f.speed_m_s) == kind]
        paper = [each for each in alike if each.method in PAPER_METHODS]
        for output in OUTPUTS:
            ours = [each for each in alike if each.output == output and each not in paper]
            if not ours:
                continue
            group = Group(flown=ours, paper=paper, section=section, factor=factor)
            figures += [_fast(group)] if kind[-1] > FAST_FROM_M_S else _slow(group)
    for method in PAPER_METHODS:
        theirs = [each for each in flown if each.method == method]
        if theirs:
            figures.append(_paper(method, theirs, section))
    return figures


def _slow(group: Group) -> list[Figure]:
    output = group.first.output
    mean_m, worst_m = (group.factor * target for target in TARGETS_M[output])
    ours, count = group.flown, sum(each.count for each in group.flown)
    perfect = [each for each in ours if each.perfect_mean_abs_m is not None]
    best = weighted_perfect(perfect)
    figures = [
        Figure(
            key=f"lag_{group.key}",
            what=f"lag distance, {group.where}: mean of absolute values",
            value=weighted(ours),
            unit="m",
            n=count,
            target=mean_m if group.is_bound else None,
            alternative=group.of_paper(weighted)
            | ({} if best is None else {"perfect knowledge": best}),
            details=summary(ours),
            section=group.section,
            row=f"lag distance, mean of absolute values: {group.row}",
        ),
        Figure(
            key=f"worst_lag_{group.key}",
            what=f"lag distance, {group.where}: worst of all seeds",
            value=most_of(each.max_abs_m for each in ours),
            unit="m",
            n=count,
            target=worst_m if group.is_bound else None,
            alternative=group.of_paper(lambda them: most_of(each.max_abs_m for each in them))
            | (
                {"perfect knowledge": most_of(e.perfect_max_abs_m for e in perfect)}
                if perfect
                else {}
            ),
            details={"seed": worst_seed(ours)},
            section=group.section,
            row=f"lag distance, worst of all seeds: {group.row}",
        ),
    ]
    return figures if output == "free-running" else [*figures, *_shares(group)]


def _shares(group: Group) -> list[Figure]:
    """Return limit ratio, spraying accuracy, and what was missed or stands apart."""
    ours, is_bound = group.flown, group.is_bound
    # A plant that was unknown, and a map of corners, are held to their lag distance alone.
    is_judged = is_bound and group.factor == 1.0
    changes = sum(each.count + each.apart + each.missed for each in ours)
    return [
        Figure(
            key=f"limit_ratio_{group.key}",
            what=f"misapplied over that of perfect knowledge, {group.where}: mean",
            value=mean_of(each.limit_ratio for each in ours),
            unit="x",
            n=len(ours),
            target=1.05 if is_judged else None,
            alternative=group.of_paper(lambda them: mean_of(each.limit_ratio for each in them)),
            details={"worst": most_of(each.limit_ratio for each in ours)},
            section=group.section,
            row=f"limit ratio: {group.row}",
        ),
        *_limit_ratio_of_none(group),
        Figure(
            key=f"spraying_accuracy_{group.key}",
            what=f"spraying accuracy, {group.where}: mean",
            value=mean_of(each.accuracy_percent for each in ours),
            unit="%",
            n=len(ours),
            target=98.5 if is_judged else None,
            is_at_least=True,
            alternative=group.of_paper(
                lambda them: mean_of(each.accuracy_percent for each in them)
            ),
            details={"worst": least_of(each.accuracy_percent for each in ours)},
            section=group.section,
            row=f"spraying accuracy: {group.row}",
        ),
        Figure(
            key=f"below_perfect_{group.key}",
            what=f"spraying accuracy below perfect knowledge, {group.where}: worst",
            value=most_of(below_perfect(each) for each in ours),
            unit="points",
            n=len(ours),
            target=0.2 if is_judged else None,
            details={"mean": mean_of(below_perfect(each) for each in ours)},
            section=group.section,
            row=f"spraying accuracy below perfect knowledge: {group.row}",
        ),
        Figure(
            key=f"settled_accuracy_{group.key}",
            what=f"settled spraying accuracy, {group.where}: mean",
            value=mean_of(each.settled_accuracy_percent for each in ours),
            unit="%",
            n=sum(each.settled_accuracy_percent is not None for each in ours),
            target=99.5 if is_judged and is_settled(ours) else None,
            is_at_least=True,
            details={"worst": least_of(each.settled_accuracy_percent for each in ours)},
            section=group.section,
            row=f"settled spraying accuracy: {group.row}",
        ),
        Figure(
            key=f"missed_{group.key}",
            what=f"changes missed, {group.where}",
            value=float(sum(each.missed for each in ours)),
            unit="",
            n=changes,
            target=0.0 if is_bound else None,
            section=group.section,
            row=f"changes missed: {group.row}",
        ),
        Figure(
            key=f"apart_{group.key}",
            what=f"changes counted apart, {group.where}",
            value=100.0 * sum(each.apart for each in ours) / changes if changes else None,
            unit="%",
            n=changes,
            target=2.0 if is_bound else None,
            section=group.section,
            row=f"changes counted apart: {group.row}",
        ),
    ]


def _limit_ratio_of_none(group: Group) -> list[Figure]:
    """Return what no compensation at all misapplies: a field that forgives everything says so."""
    theirs = [each for each in group.paper if each.method == "none"]
    if not theirs or group.first.output != "gpio":
        return []
    return [
        Figure(
            key=f"none_limit_ratio_{group.key}",
            what=f"misapplied over that of perfect knowledge, paper's none, {group.where}: mean",
            value=mean_of(each.limit_ratio for each in theirs),
            unit="x",
            n=len(theirs),
            target=NONE_RATIO_MIN,
            is_at_least=True,
            section=group.section,
            row="limit ratio of no compensation",
        )
    ]


def _fast(group: Group) -> Figure:
    ours, speed = group.flown, group.first.speed_m_s
    mean_abs = weighted(ours)
    worst = most_of(each.max_abs_m for each in ours)
    return Figure(
        key=f"lag_{group.key}",
        what=f"lag in time, {group.where}: mean of absolute values",
        value=None if mean_abs is None else mean_abs / speed,
        unit="s",
        n=sum(each.count for each in ours),
        target=FAST_TARGET_S,
        details={"worst_s": None if worst is None else worst / speed, **summary(ours)},
        section=group.section,
        row=f"lag in time at 8 to 15 m/s: {group.row}",
    )


def _paper(method: str, theirs: Sequence[Flown], section: str) -> Figure:
    return Figure(
        key=f"paper_{method}",
        what=f"settled lag distance, the paper's controller, {method}, {PAPER_M_S:g} m/s: mean",
        value=mean_of(each.settled_mean_m for each in theirs),
        unit="m",
        n=len(theirs),
        details=summary(theirs),
        section=section,
    )


def summary(flown: Sequence[Flown]) -> dict[str, Any]:
    """Return what else is known of these flights, over all seeds."""
    return {
        "mean_m": mean_of(each.mean_m for each in flown),
        "worst_m": most_of(each.max_abs_m for each in flown),
        "worst_seed_mean_abs_m": most_of(each.mean_abs_m for each in flown),
        "worst_seed": worst_seed(flown),
        "settled_mean_m": mean_of(each.settled_mean_m for each in flown),
        "settled_mean_abs_m": mean_of(each.settled_mean_abs_m for each in flown),
        "limit_ratio": mean_of(each.limit_ratio for each in flown),
        "misapplied_percent": mean_of(each.misapplied_percent for each in flown),
        "spraying_accuracy_percent": mean_of(each.accuracy_percent for each in flown),
        "settled_accuracy_percent": mean_of(each.settled_accuracy_percent for each in flown),
        "perfect_accuracy_percent": mean_of(each.perfect_accuracy_percent for each in flown),
        "perfect_worst_m": most_of(each.perfect_max_abs_m for each in flown),
        "missed": sum(each.missed for each in flown),
        "apart": sum(each.apart for each in flown),
        "off_target_ml": most_of(each.off_target_ml for each in flown),
        "border_margin_m": mean_of(each.border_margin_m for each in flown),
        "border_bound_m": mean_of(each.border_bound_m for each in flown),
        "seeds": len(flown),
    }

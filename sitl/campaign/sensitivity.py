"""Which settings matter: what SALib makes of a design that is made for it, with its intervals.

`sobol` designs give shares of variance, of a setting alone (S1) and with all its interactions (ST).
`morris` designs give the mean size of its effect over the whole range (mu*), and how much that
differs from place to place (sigma). Of a Latin hypercube, S1 by RBD-FAST.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.errors import ConfigError
from companion.wording import install_command
from sitl.campaign.design import GRID, HYPERCUBE, MORRIS, MORRIS_LEVELS, SOBOL, problem_of
from sitl.campaign.show import CONFIDENCE, Floats, Rows, plain

RESAMPLES = 200
FAST_POINTS = 65
# Fewer are too few to draw again from. Of functions whose indices are known (Ishigami's, a straight
# line), 95 % intervals held S1 and ST in at least 95 % of 100 designs with 64 samples, and in 68 to
# 84 % with 2; mu* in 91 % with 16 trajectories, and in 52 to 84 % with 2. Measured on 2026-11-26.
SAMPLES_FOR_INTERVAL = {SOBOL: 64, MORRIS: 16}


@dataclass(frozen=True, slots=True, kw_only=True)
class Index:
    """How much one setting matters for one figure.

    Its 95 % interval is by bootstrap; there is none of too few samples.
    """

    case: str
    figure: str
    setting: str
    name: str
    value: float
    low: float | None
    high: float | None


def sensitivity_of(rows: Rows) -> list[Index]:
    """Return every index; nothing where the design is a grid or has too few points.

    Raises:
        ConfigError: SALib is missing, or flights are.
    """
    campaign = rows.campaign
    if campaign.kind == GRID or not campaign.factors:
        return []
    if campaign.kind == HYPERCUBE and len(campaign.points) < FAST_POINTS:
        return []
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"sensitivity needs SALib; {install_command('campaign')}") from error
    found = []
    size, has_interval = len(campaign.points), _has_interval(rows)
    for number, (case, _) in enumerate(campaign.cases):
        chosen = rows.point // size == number
        for figure, values in rows.figures.items():
            means = rows.by_point(values, chosen)
            if len(means) < size or np.isnan(means).any() or not np.ptp(means) > 0.0:
                continue
            found += [
                Index(case=case, figure=figure, setting=setting, name=name, value=value,
                      low=low if has_interval else None, high=high if has_interval else None)
                for setting, name, value, low, high in _indices(rows, means)
            ]  # fmt: skip
    return found


def notes_of(rows: Rows, found: Sequence[Index]) -> Iterator[str]:
    """Yield why figures have no sensitivity, and why indices have no interval."""
    campaign = rows.campaign
    if found and not _has_interval(rows):
        needed = SAMPLES_FOR_INTERVAL[campaign.kind]
        yield (
            f"no intervals of sensitivity: {campaign.samples} samples are too few for a "
            f"{campaign.kind} design; write design.samples = {needed} or more"
        )
    if campaign.kind == GRID or len({each.figure for each in found}) == len(rows.figures):
        return
    if campaign.kind == HYPERCUBE and len(campaign.points) < FAST_POINTS:
        yield f"no sensitivity: a latin-hypercube design needs {FAST_POINTS} samples or more"
        return
    yield (
        "no sensitivity of figures that do not vary, or that flights lack: fly the rest of the "
        "campaign, or leave out values that fail"
    )


def _has_interval(rows: Rows) -> bool:
    return rows.campaign.samples >= SAMPLES_FOR_INTERVAL.get(rows.campaign.kind, 0)


def _indices(rows: Rows, means: Floats) -> Iterator[tuple[str, str, float, float, float]]:
    from SALib.analyze import morris, rbd_fast, sobol

    campaign = rows.campaign
    problem, seed = problem_of(campaign), campaign.seed
    names = problem["names"]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if campaign.kind == SOBOL:
            found = sobol.analyze(
                problem, means, calc_second_order=campaign.second_order, conf_level=CONFIDENCE,
                num_resamples=RESAMPLES, seed=seed,
            )  # fmt: skip
            kinds: tuple[str, ...] = ("S1", "ST")
        elif campaign.kind == HYPERCUBE:
            found = rbd_fast.analyze(
                problem, campaign.points, means, conf_level=CONFIDENCE, num_resamples=RESAMPLES,
                seed=seed,
            )  # fmt: skip
            kinds = ("S1",)
        else:
            found = morris.analyze(
                problem, campaign.points, means, conf_level=CONFIDENCE, num_resamples=RESAMPLES,
                num_levels=MORRIS_LEVELS, seed=seed,
            )  # fmt: skip
            kinds = ("mu_star",)
    for kind in kinds:
        for name, value, half in zip(names, found[kind], found[f"{kind}_conf"], strict=True):
            yield name, kind, float(value), float(value - half), float(value + half)
    if campaign.kind == MORRIS:
        spread = _spread_of_effects(rows, means)
        for name, value, (low, high) in zip(names, found["sigma"], spread, strict=True):
            yield name, "sigma", float(value), low, high


def _spread_of_effects(rows: Rows, means: Floats) -> list[tuple[float, float]]:
    """Return intervals of sigma, which SALib gives none of: by drawing trajectories again."""
    points = rows.campaign.points
    steps = points.shape[1] + 1
    x, y = points.reshape(-1, steps, points.shape[1]), means.reshape(-1, steps)
    moved = np.diff(x, axis=1)
    effect = np.diff(y, axis=1)[:, :, None] * np.sign(moved) / np.abs(moved).sum(axis=2)[:, :, None]
    effects = effect.sum(axis=1)
    rng = np.random.default_rng(np.random.SeedSequence(rows.campaign.seed))
    drawn = rng.integers(0, len(effects), size=(RESAMPLES, len(effects)))
    spread = effects[drawn].std(axis=1, ddof=1)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(spread, [tail, 1.0 - tail], axis=0)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def sensitivity_lines(found: Sequence[Index]) -> Iterator[str]:
    """Yield a table for each case and figure."""
    for case, figure in dict.fromkeys((each.case, each.figure) for each in found):
        rows = [each for each in found if (each.case, each.figure) == (case, figure)]
        kinds = list(dict.fromkeys(each.name for each in rows))
        table: list[tuple[str, ...]] = [(f"{figure}{f', {case}' if case else ''}", *kinds)]
        for setting in dict.fromkeys(each.setting for each in rows):
            of: dict[str, Any] = {each.name: each for each in rows if each.setting == setting}
            table.append((setting, *(_cell(of[kind]) for kind in kinds)))
        yield ""
        yield from plain(table)


def _cell(found: Index) -> str:
    if found.low is None or found.high is None:
        return f"{found.value:.3f}"
    return f"{found.value:.3f} [{found.low:.3f}, {found.high:.3f}]"

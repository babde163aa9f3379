"""What `vrspray calibrate lag` answers: JSON, a `[lag]` table to paste, lines for a person."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.calibration.identify import STEPS_MIN
from analysis.calibration.steps import Kind
from companion.errors import VrsprayError

if TYPE_CHECKING:
    from analysis.calibration.identify import Estimate, Identified

# Which of an estimate's three figures is the safe one to fly with; the others fly their value.
SAFE_LOW, SAFE_HIGH = "on_start_s", "off_end_s"
MS = 1000.0


class TooFewStepsError(VrsprayError):
    """The journal does not say all lags."""


def refusal(found: Identified) -> str | None:
    """Return in one line what is missing; None where nothing is."""
    if not found.missing:
        return None
    used = {kind: sum(fit.step.kind is kind for fit in found.fits) for kind in Kind}
    kinds = ", ".join(f"{kind.value} {used[kind]}" for kind in found.missing)
    why = rejected_text(found)
    return (
        f"too few good steps ({kinds}; each kind needs {STEPS_MIN}); "
        + (f"not used: {why}; " if why else "")
        + "fly the mission of `vrspray calibrate mission` with a flow meter"
    )


def rejected_text(found: Identified) -> str:
    """Return why steps were not used, the most frequent reason first."""
    return ", ".join(f"{count} {reason.value}" for reason, count in found.rejected.most_common())


def estimates(found: Identified) -> dict[str, Estimate]:
    """Return the estimates by their keys of the configuration."""
    if found.missing or found.on_start is None or found.off_end is None:
        raise TooFewStepsError(refusal(found) or "too few good steps")
    result = {f"{kind.value}_s": found.lags[kind] for kind in Kind}
    return result | {SAFE_LOW: found.on_start, SAFE_HIGH: found.off_end}


def settings(found: Identified) -> dict[str, float]:
    """Return what to fly with: the lags, and of both ends the side on which nothing goes astray.

    Lags cannot be negative; a configured `output_s` that is longer than the whole lag makes them.
    """
    chosen = {}
    for key, estimate in estimates(found).items():
        value = estimate.value
        if key == SAFE_LOW:
            value = min(estimate.low, found.lags[Kind.ON].value)
        elif key == SAFE_HIGH:
            value = max(estimate.high, found.lags[Kind.OFF].value)
        chosen[key] = round(max(value, 0.0), 4)
    return chosen | {"output_s": found.output_s}


def as_json(found: Identified) -> dict[str, Any]:
    """Return the answer in the shape of the contract, and what was not used."""
    result: dict[str, Any] = {
        key: {
            "value": estimate.value,
            "low": estimate.low,
            "high": estimate.high,
            "count": estimate.count,
        }
        for key, estimate in estimates(found).items()
    }
    return result | {
        "output_s": found.output_s,
        "rejected": {reason.value: count for reason, count in found.rejected.items()},
        "toml": "\n".join(toml_lines(found)),
    }


def toml_lines(found: Identified) -> Iterator[str]:
    """Yield the keys of the `[lag]` table that were measured."""
    yield "[lag]"
    for key, value in settings(found).items():
        yield f"{key} = {value:.4f}"


def table_lines(found: Identified) -> Iterator[str]:
    """Yield the answer for a person."""
    yield f"lags after the order at the output (output_s = {found.output_s:g} s), 95 % interval:"
    for key, estimate in estimates(found).items():
        yield (
            f"  {key:11s} {estimate.value * MS:7.1f} ms  "
            f"({estimate.low * MS:.1f} to {estimate.high * MS:.1f}), {estimate.count} steps"
        )
    why = rejected_text(found)
    yield f"  not used: {why}" if why else "  all steps were used"
    yield "on_start_s below is the low end and off_end_s the high end: the safe sides at a border."
    yield "paste over the same keys of your configuration:"
    yield ""
    yield from toml_lines(found)


def draw(found: Identified, path: Path) -> None:
    """Draw the lag of every step used, by kind, with the means and their intervals."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, kind in enumerate(Kind):
        fits = [fit for fit in found.fits if fit.step.kind is kind]
        spread: Sequence[float] = [
            place + 0.5 * (i + 0.5) / max(len(fits), 1) - 0.25 for i in range(len(fits))
        ]
        lags_ms = [(fit.lag_s - found.output_s) * MS for fit in fits]
        sds_ms = [fit.sd_s * MS for fit in fits]
        axes.errorbar(spread, lags_ms, yerr=sds_ms, fmt=".", color="0.6", linewidth=0.8)
        if kind in found.lags:
            mean = found.lags[kind]
            half_ms = (mean.high - mean.value) * MS
            axes.errorbar([place], [mean.value * MS], yerr=[half_ms], fmt="o", capsize=6)
    axes.set_xticks(range(len(Kind)), [kind.value for kind in Kind])
    axes.set_ylabel("lag after the order at the output [ms]")
    axes.set_title("every step (1 sd) and the mean of each kind (95 %)")
    figure.savefig(path, dpi=110)

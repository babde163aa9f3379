"""Whether the scatter of a bucket test justifies a smoother curve than its means, and which.

Catches repeated at one duty say how far a catch scatters (pure error, relative to its flow). A
candidate curve is admitted where the F-test of its lack of fit against that scatter does not
speak against it; of those admitted and the means themselves the one with the least expected error
is taken (Mallows 1973: C_p). Candidates are a straight line and natural cubic smoothing splines
(Green and Silverman 1994), all by weighted least squares, all strictly rising. The controller goes
straight between their values at the measured duties.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.student import f_above, t_factor

Floats = NDArray[np.float64]

# A curve is only believed to be smoother than its means where a test as sharp as this one sees no
# difference. At the usual 5 % a bend twice as large as the scatter passes for none, and the
# smoothed curve is farther from the truth than the means are.
ADMIT_P = 0.25
# Repeats beyond the first at each duty: with fewer the scatter itself is hardly known.
SPARE_MIN = 4
# Below this relative scatter catches are not measurements but figures worked out.
SCATTER_MIN = 1e-9
# From nearly straight to nearly the means, as multiples of the mean weight.
STIFFNESS = tuple(10.0 ** (0.25 * k) for k in range(20, -25, -1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Repeats:
    """The catches at one duty: mean flow, their weight, and squared relative deviations."""

    duty: float
    flow_l_min: float
    count: int
    weight: float
    squares: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """What kind of curve was taken, and the test that it passed.

    `freedom` is how many free numbers the curve has: 2 for a line, as many as points for the
    means. F, its degrees of freedom and p are those of the curve's lack of fit, `line_p` that of
    the straight line; None where they are not known: for the means, without enough repeats.
    """

    kind: Literal["line", "smooth", "points"]
    freedom: float
    f: float | None = None
    f_freedom: tuple[float, float] | None = None
    p: float | None = None
    line_p: float | None = None

    def as_json(self, count: int) -> dict[str, object]:
        """Return it with the test's name and limit; `count` is how many points there are."""
        return {
            "kind": self.kind,
            "words": self.words(count),
            "free_numbers": self.freedom,
            "test": "F, lack of fit against the scatter of repeats",
            "f": self.f,
            "f_degrees_of_freedom": None if self.f_freedom is None else list(self.f_freedom),
            "p": self.p,
            "p_needed": ADMIT_P,
            "p_of_a_straight_line": self.line_p,
        }

    def words(self, count: int) -> str:
        """Say what was taken and why; `count` is how many points there are."""
        if self.f is not None and self.f_freedom is not None and self.p is not None:
            fit = (
                f"lack of fit F = {self.f:.2f} on {self.f_freedom[0]:.3g} and "
                f"{self.f_freedom[1]:.3g} degrees of freedom, p = {self.p:.2f}"
            )
            if self.kind == "line":
                return f"a straight line; {fit}"
            line = "" if self.line_p is None else f"; a straight line has p = {self.line_p:.2g}"
            return f"smoothed to {self.freedom:.1f} free numbers of {count}; {fit}{line}"
        if self.line_p is None:
            return f"the means; without {SPARE_MIN} repeats nothing tells scatter from bends"
        return (
            "the means; they scatter too little for a smoother curve "
            f"(a straight line has p = {self.line_p:.2g})"
        )


def scatter_squared(points: Sequence[Repeats]) -> tuple[float | None, int]:
    """Return the relative variance of a catch by what was repeated, and how many repeats say so."""
    spare = sum(point.count - 1 for point in points)
    if spare < SPARE_MIN:
        return None, spare
    variance = sum(point.squares for point in points) / spare
    return (variance, spare) if variance > SCATTER_MIN**2 else (None, spare)


def fit_means(points: Sequence[Repeats]) -> tuple[Fit, list[float]]:
    """Return the curve at the duties of `points`, in their order; of the means it need not rise.

    Raises:
        ValueError: where the flow does not rise by more than its catches scatter.
    """
    means = [point.flow_l_min for point in points]
    variance, spare = scatter_squared(points)
    if variance is None or len(points) < 3:
        return Fit(kind="points", freedom=float(len(points))), means
    law = _Smoother(points)
    law.check_rise(variance, spare)
    best: tuple[float, Fit, Floats] | None = None
    line_p = None
    for kind, hat in law.candidates():
        flows, misfit = law.apply(hat)
        freedom = float(np.trace(hat))
        f, f_freedom, p = _lack_of_fit(hat, misfit, variance, spare)
        line_p = p if kind == "line" else line_p
        rises = flows[0] > 0.0 and bool(np.all(np.diff(flows) > 0.0))
        expected = misfit + 2.0 * variance * freedom
        if p >= ADMIT_P and rises and (best is None or expected < best[0]):
            fit = Fit(kind=kind, freedom=freedom, f=f, f_freedom=f_freedom, p=p, line_p=line_p)
            best = (expected, fit, flows)
    if best is None or (law.rises and 2.0 * variance * len(points) <= best[0]):
        return Fit(kind="points", freedom=float(len(points)), line_p=line_p), means
    return best[1], best[2].tolist()


class _Smoother:
    """Weighted least squares through the means, from a straight line to nearly themselves."""

    def __init__(self, points: Sequence[Repeats]) -> None:
        self._duty = np.array([point.duty for point in points])
        self._flow = np.array([point.flow_l_min for point in points])
        # The deviation of a catch grows with its flow.
        self._root = np.sqrt([point.weight for point in points]) / self._flow

    @property
    def rises(self) -> bool:
        """Whether the means alone are a curve."""
        return bool(np.all(np.diff(self._flow) > 0.0))

    def check_rise(self, variance: float, spare: int) -> None:
        """Refuse flows in which no rise can be seen.

        Raises:
            ValueError: where the slope is within its 95 % interval of 0.
        """
        columns = self._columns()
        spread = np.linalg.inv(columns.T @ columns)
        _, slope = spread @ columns.T @ (self._root * self._flow)
        if not slope > t_factor(spare) * np.sqrt(variance * spread[1, 1]):
            raise ValueError(
                "the flow does not rise by more than the catches scatter "
                f"({100.0 * np.sqrt(variance):.1f} %, 1 sd)"
            )

    def candidates(self) -> Iterator[tuple[Literal["line", "smooth"], Floats]]:
        """Yield what turns weighted means into weighted fits, the stiffest first."""
        columns = self._columns()
        yield "line", columns @ np.linalg.pinv(columns)
        bend = self._bend() / self._root[:, None] / self._root[None, :]
        count = len(self._duty)
        for stiffness in STIFFNESS:
            yield "smooth", np.linalg.inv(np.eye(count) + stiffness * count / np.trace(bend) * bend)

    def apply(self, hat: Floats) -> tuple[Floats, float]:
        """Return the flows of a candidate and its weighted sum of squares."""
        seen = self._root * self._flow
        fitted = hat @ seen
        return fitted / self._root, float(np.sum((seen - fitted) ** 2))

    def _columns(self) -> Floats:
        columns: Floats = self._root[:, None] * np.c_[np.ones_like(self._duty), self._duty]
        return columns

    def _bend(self) -> Floats:
        """Return the matrix whose form is the integral of the second derivative squared."""
        step = np.diff(self._duty)
        count = len(self._duty)
        second = np.zeros((count, count - 2))
        band = np.zeros((count - 2, count - 2))
        for j in range(count - 2):
            a, b = 1.0 / step[j], 1.0 / step[j + 1]
            second[j : j + 3, j] = (a, -a - b, b)
            band[j, j] = (step[j] + step[j + 1]) / 3.0
            if j + 1 < count - 2:
                band[j, j + 1] = band[j + 1, j] = step[j + 1] / 6.0
        bend: Floats = second @ np.linalg.solve(band, second.T)
        return bend


def _lack_of_fit(
    hat: Floats, misfit: float, variance: float, spare: int
) -> tuple[float, tuple[float, float], float]:
    """Return F, its degrees of freedom and p of a linear smoother (Cleveland and Devlin 1988)."""
    left = np.eye(len(hat)) - hat
    form = left @ left.T
    first, second = float(np.trace(form)), float(np.trace(form @ form))
    if not second > 0.0:
        return 0.0, (0.0, float(spare)), 1.0
    f = misfit / first / variance
    freedom = (first * first / second, float(spare))
    return f, freedom, f_above(f, *freedom)

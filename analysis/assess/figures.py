"""The figures of one flight that people quote, each worked out once.

Headline, tiles, balance and legal record read them here, so that no page contradicts itself.
Litres are those of the flow meter where there is one, else those of the model, and say which.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from analysis.assess.causes import Cause

if TYPE_CHECKING:
    from analysis.assess.assessment import Assessment, Essentials

By = Literal["flow meter", "model", "nothing"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What was applied, where, and how well; None where nothing is known of it.

    `applied_by` says what the litres are known by. `missed_m2` is ground that the aircraft passed
    and left bare, `untreated_m2` all ground with a rate that this flight did not treat.
    `worst_m` is a bound: `analysis.assess.worst`.
    """

    applied_l: float | None
    applied_by: By | None
    prescribed_l: float | None
    off_percent: float | None
    area_ha: float | None
    mean_rate_l_ha: float | None
    asked_rate_l_ha: float | None
    within_10_percent: float | None
    mean_lag_m: float | None
    lag_count: int
    worst_m: float | None
    worst_why_not: str
    outside_ml: float | None
    missed_m2: float | None
    doubled_m2: float | None
    untreated_m2: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all figures."""
        return asdict(self)


def nothing_sprayed(area_ha: float | None, *, is_known: bool) -> Figures:
    """Return the figures of a flight without spraying, or of one of which too little is known."""
    return Figures(
        applied_l=0.0 if is_known else None,
        applied_by="nothing" if is_known else None,
        prescribed_l=None,
        off_percent=None,
        area_ha=area_ha if is_known else None,
        mean_rate_l_ha=None,
        asked_rate_l_ha=None,
        within_10_percent=None,
        mean_lag_m=None,
        lag_count=0,
        worst_m=None,
        worst_why_not="nothing was sprayed" if is_known else "too little can be read",
        outside_ml=None,
        missed_m2=None,
        doubled_m2=None,
        untreated_m2=None,
    )


def figures_of(
    assessment: Assessment | Essentials | None, *, area_ha: float, is_whole: bool = True
) -> Figures:
    """Return the figures; `area_ha` is the ground that open valves went over.

    What was sprayed in a flight of which too little can be read, nobody knows: None, and not zero.
    """
    if assessment is None or assessment.evaluation.applied_ml <= 0.0:
        return nothing_sprayed(area_ha, is_known=is_whole)
    evaluation, balance, causes = assessment.evaluation, assessment.balance, assessment.causes
    metered = balance.meter_l is not None
    applied_l = balance.meter_l if balance.meter_l is not None else balance.model_l
    asked_l = balance.prescribed_l
    return Figures(
        applied_l=applied_l,
        applied_by="flow meter" if metered else "model",
        prescribed_l=asked_l,
        off_percent=(
            balance.meter_to_prescribed_percent if metered else balance.model_to_prescribed_percent
        ),
        area_ha=area_ha,
        mean_rate_l_ha=applied_l / area_ha if area_ha > 0.0 else None,
        asked_rate_l_ha=asked_l / area_ha if area_ha > 0.0 else None,
        within_10_percent=causes.within_percent,
        mean_lag_m=evaluation.lag_distance_m.mean_abs,
        lag_count=evaluation.lag_distance_m.count,
        worst_m=assessment.worst.bound_m,
        worst_why_not=assessment.worst.why_not,
        outside_ml=evaluation.off_target_ml,
        missed_m2=causes.skipped_m2 + causes.by_cause[Cause.INHIBIT],
        doubled_m2=causes.doubled_m2,
        untreated_m2=causes.untreated_m2,
    )

"""What was sprayed by four ways to know it: prescription, model, meter, tank."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.flown.metered import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flown.applied_flight import AppliedFlight, Floats
    from analysis.strips import Strip

ML_PER_L = 1000.0
# A level that rises by more within a reading is a refill, and no noise.
REFILL_L = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Balance:
    """Litres of a flight; None where there is no such sensor, or it said too little.

    `prescribed_l` is the integral of the prescription over the ground that the strips passed.
    Percentages are of what stands second in their name. `meter_spread_percent` is one standard
    deviation of the meter as the configuration of the fault detection has it.
    """

    prescribed_l: float
    model_l: float
    meter_l: float | None
    tank_l: float | None
    tank_start_l: float | None
    tank_end_l: float | None
    refilled_l: float | None
    model_to_prescribed_percent: float | None
    meter_to_prescribed_percent: float | None
    meter_to_model_percent: float | None
    tank_to_model_percent: float | None
    tank_to_meter_percent: float | None
    meter_spread_percent: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all figures."""
        return asdict(self)


def balance_of(flight: AppliedFlight, strips: Sequence[Strip], model_ml: float) -> Balance:
    """Return the balance of a flight whose model put out `model_ml`."""
    asked_l = sum(float(strip.asked_ml[-1]) for strip in strips) / ML_PER_L
    model_l = model_ml / ML_PER_L
    meter_l = None
    if flight.meter_ml is not None:
        _, count_ml = counted(flight.meter_ml)
        meter_l = float(count_ml[-1]) / ML_PER_L if len(count_ml) > 1 else None
    start_l, end_l, refilled_l = _tank(flight)
    tank_l = None
    if start_l is not None and end_l is not None and refilled_l is not None:
        tank_l = start_l + refilled_l - end_l
    detection = flight.setup.detection
    return Balance(
        prescribed_l=asked_l,
        model_l=model_l,
        meter_l=meter_l,
        tank_l=tank_l,
        tank_start_l=start_l,
        tank_end_l=end_l,
        refilled_l=refilled_l,
        model_to_prescribed_percent=_off(model_l, asked_l),
        meter_to_prescribed_percent=_off(meter_l, asked_l),
        meter_to_model_percent=_off(meter_l, model_l),
        tank_to_model_percent=_off(tank_l, model_l),
        tank_to_meter_percent=_off(tank_l, meter_l),
        meter_spread_percent=None if detection is None else 100.0 * detection.spread,
    )


def _tank(flight: AppliedFlight) -> tuple[float | None, float | None, float | None]:
    """Return first and last level, and what was filled in between."""
    if flight.tank_l is None:
        return None, None, None
    level: Floats = flight.tank_l.value[np.isfinite(flight.tank_l.value)]
    if len(level) < 2:
        return None, None, None
    rises = np.diff(level)
    return float(level[0]), float(level[-1]), float(rises[rises > REFILL_L].sum())


def _off(value: float | None, reference: float | None) -> float | None:
    if value is None or reference is None or not reference > 0.0:
        return None
    return 100.0 * (value - reference) / reference

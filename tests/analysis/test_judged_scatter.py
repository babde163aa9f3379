"""The bound on the worst change of a flight over cells, and the demo, held against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import sitl.demo
from analysis.evaluation import Evaluation, FlightRecord, changes_of, evaluate
from analysis.strips import strips_of
from sitl.demo import Job, fly_one
from sitl.plant import AveragedPlant
from sitl.profile import load_profile
from tests.analysis.test_judged_figures import Flown, fly
from tests.ground_judge import Field, Truth, judge

DRAWS, DRAWS_OF_CHANGES = 100, 10
CELL_M, CELLS = 2.0, 16
RATES = (10, 14, 18, 22, 26)


def zones() -> list[tuple[int, list[tuple[float, float]]]]:
    """Return a map of cells of two metres, five rates, as programs for spot maps make it."""
    wave = np.add.outer(np.sin(np.arange(CELLS) / 1.3), np.cos(np.arange(CELLS) / 1.7))
    number = np.clip(((wave + 2.0) / 4.0 * len(RATES)).astype(int), 0, len(RATES) - 1)
    found = []
    for (row, column), each in np.ndenumerate(number):
        east, north = np.array([column, column + 1]) * CELL_M, np.array([row, row + 1]) * CELL_M
        lon, lat = 114.544 + east / 90_150.0, 35.996 + north / 110_958.0
        ring = [(lon[0], lat[0]), (lon[1], lat[0]), (lon[1], lat[1]), (lon[0], lat[1])]
        found.append((RATES[each], [(float(x), float(y)) for x, y in ring]))
    return found


@dataclass(frozen=True)
class Draw:
    """What another sprayer of the same kind would have done in the same flight."""

    record: FlightRecord
    litres: float
    metered_l: float


def draws(flown: Flown, count: int) -> Iterator[Draw]:
    """Yield the flight with valves and meters drawn anew: the orders stay."""
    with np.load(flown.journal.parent / "truth.npz") as file:
        truth = {name: file[name] for name in file.files}
    record = replace(
        flown.assessed.record,
        **{name: truth[name] for name in ("time_s", "east_m", "north_m", "heading_deg")},
        volume_ml=truth["volume_ml"],
        unknown=(),
    )
    profile = load_profile("wang-2024")
    orders = (truth["order_time_s"], truth["order_valve"], truth["order_duty"])
    for seed in range(count):
        plant = AveragedPlant(profile, seed=seed, start_s=float(truth["time_s"][0]))
        for at_s, valve, duty in zip(*(each.tolist() for each in orders), strict=True):
            plant.record_change(at_s, int(valve), duty)
        volume_ml = plant.volume_ml(truth["time_s"])
        yield Draw(
            record=replace(record, volume_ml=volume_ml),
            litres=float((volume_ml[-1] - volume_ml[0]).sum()) / 1e3,
            metered_l=float(np.diff(plant.meter_volume_ml(truth["time_s"][[0, -1]]))[0]) / 1e3,
        )


@pytest.mark.timeout(400)
def test_the_bound_over_small_cells_holds_for_scattered_valves(tmp_path: Path) -> None:
    flown = fly(tmp_path, tuple(zones()), True, "--angle-deg", "0")
    said = flown.contents["verdict"]
    inside = said["change_count"] - said["unjudged"].get("border", 0)
    assert said["lag_count"] > 0.75 * inside
    assert said["unjudged"].get("close", 0) < 0.15 * inside
    within, metered, bounded = flown.contents["balance"]["meter_within_percent"] / 100.0, 0, 0
    # All figures of a hundred are judged by `python -m tests.bench.ground_figures`.
    for number, draw in enumerate(draws(flown, DRAWS)):
        metered += abs(draw.metered_l - draw.litres) <= within * draw.metered_l
        if number < DRAWS_OF_CHANGES:
            worst_m = changes_of(draw.record, strips_of(draw.record)).lag_distance_m.max_abs
            bounded += worst_m is not None and worst_m <= said["worst_m"]
    assert metered >= 0.95 * DRAWS
    assert bounded == DRAWS_OF_CHANGES


def test_the_demo_prints_the_litres_and_what_fell_outside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    records: list[FlightRecord] = []

    def kept(record: FlightRecord) -> Evaluation:
        records.append(record)
        return evaluate(record)

    monkeypatch.setattr(sitl.demo, "evaluate", kept)
    job = Job(speed_m_s=6.0, method="scheduled", fidelity="averaged", output="servo", seed=3)
    said, (record,) = fly_one(job).evaluation, records
    valves = record.boom.valves
    truth = Truth(
        time_s=record.time_s, east_m=record.east_m, north_m=record.north_m,
        heading_deg=record.heading_deg, volume_ml=record.volume_ml,
        right_m=np.array([each.right_m for each in valves]),
        forward_m=np.array([each.forward_m for each in valves]),
        width_m=np.array([each.width_m for each in valves]), origin_deg=(0.0, 0.0),
    )  # fmt: skip
    plots = [(each.polygon, each.rate_l_ha) for each in record.prescription.zones]
    true = judge([truth], Field(zones=plots, outline=record.prescription.field))
    assert said.applied_ml == pytest.approx(1e3 * true.applied_l, rel=1e-6)
    assert said.off_target_ml == pytest.approx(true.outside_ml, abs=0.5)

"""Times and turns of the plan's model beside those of the twin's copter.

    python -m tests.bench.turns

For each way to turn a serpentine of ten passes of 120 m, 7 m apart, at 6 m/s and 2.5 m/s2, without
gusts: the time of a turn as the model has it for an aircraft that stops at every corner, and as
the twin flies it, which does so and turns its nose at 90 degrees a second; strafing it keeps it.
"""

from __future__ import annotations

import json
import sys
from typing import Literal

from missions.corners import Motion
from missions.plan import Leg as Planned
from missions.plan import nose_s
from sitl.vehicle import TURN_RATE_DEG_S, Leg, Route, Vehicle

PASSES, LONG_M, ASIDE_M, SPEED_M_S, ACCELERATION_M_S2 = 10, 120.0, 7.0, 6.0, 2.5


def serpentine() -> list[tuple[float, float]]:
    """Return the corners of the passes."""
    points = []
    for number in range(PASSES):
        ends = [0.0, LONG_M] if number % 2 == 0 else [LONG_M, 0.0]
        points += [(number * ASIDE_M, north_m) for north_m in ends]
    return points


def twin_s(turn: Literal["stop", "strafe"]) -> float:
    """Return the time of the whole serpentine as the twin flies it."""
    points = serpentine()
    route = Route(
        start_east_m=0.0, start_north_m=0.0, height_m=3.5,
        legs=tuple(
            Leg(east_m=east_m, north_m=north_m, speed_m_s=SPEED_M_S, kind="spray")
            for east_m, north_m in points[1:]
        ),
    )  # fmt: skip
    vehicle = Vehicle(
        route, start_s=0.0, seed=1, acceleration_m_s2=ACCELERATION_M_S2, gust_m_s=0.0,
        heading="course" if turn == "stop" else 0.0,
    )  # fmt: skip
    return float(vehicle.fly_to_end().time_s[-1])


def model_s(turn: Literal["stop", "strafe"]) -> float:
    """Return the time of the whole serpentine as the plan has it."""
    motion = Motion(speed_m_s=SPEED_M_S, acceleration_m_s2=ACCELERATION_M_S2, turn=turn)
    points = serpentine()
    leg = Planned(kind="spray", points=tuple(points), speed_m_s=SPEED_M_S)
    standing_s = nose_s([leg], turn=turn, rate_deg_s=TURN_RATE_DEG_S)
    return (
        PASSES * motion.leg_s(LONG_M) + (PASSES - 1) * motion.between_passes_s(ASIDE_M) + standing_s
    )


def main() -> int:
    """Print the seconds of one turn, without the pass."""
    pass_s = LONG_M / SPEED_M_S
    rows = {}
    turns: tuple[Literal["stop", "strafe"], ...] = ("stop", "strafe")
    for turn in turns:
        rows[turn] = {
            "model_turn_s": (model_s(turn) - PASSES * pass_s) / (PASSES - 1),
            "twin_turn_s": (twin_s(turn) - PASSES * pass_s) / (PASSES - 1),
        }
    sys.stdout.write(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What keeps a flight along a log from being sprayed as exactly as with perfect knowledge.

    python -m tools.studies.along_limits LOG.BIN [LOG.BIN ...] [--flights 3] [--page]

Closed loop, 10 positions a second: the companion is given in turn what it cannot know (the smoothed
velocity, place and nose; all that 50 times a second; valves that are alike), and what it could ask
for: attitude and accelerometer of the log. Then open loop: how far off the speed is that it
foretells, by what the autopilot told afterwards.
"""

from __future__ import annotations

import argparse
import heapq
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import sitl.along
from companion.core.estimator import Track, estimate, observe
from companion.core.types import AttitudeReport, ImuReport, Input, Telemetry
from sitl.along import AlongOptions, Bed, figures_of, fly_method, heard, prepare, row_of
from sitl.earth import Earth
from sitl.recorded import rows_of

RATE_HZ, OFTEN_HZ, LEADS_S, MOVING_M_S = 10.0, 50.0, (0.1, 0.2, 0.3), 1.0
LATE_S = 0.005
PAGE = Path(__file__).parents[2] / "docs" / "measurements" / "real-limits.md"
PAGE_TEXT = """<!-- Written by `python -m tools.studies.along_limits --page`; do not edit. -->

# What limits flights along logs

`python -m tools.studies.along_limits`, {today}: positions at 10 Hz, three flights a row.

## Told the truth

*As told* is what the log's autopilot told. In the other rows the companion is told the smoothed
velocity, place or nose, all three 50 times a second (*often*), or flies valves that are *alike*.
Perfect knowledge knows each valve.

{closed}

- Not knowing single valves is the largest part of what is misapplied beyond perfect knowledge;
  errors of velocity, place and nose together are less than half of that.
- Told the truth 50 times a second the companion still misapplies more than 1.5 times as much as
  perfect knowledge on q130: in turns nobody tells it when the nose will begin to turn. On q116 it
  stays below that once its valves are alike, as after `calibrate valves`.

## Attitude, accelerometer and mission

How far off (rms) the speed along the course is that is foretold, by what the autopilot told later.

{opened}

Attitude at 10 Hz and accelerometer at 25 Hz are not believed beside the positions of these logs:
they foretell them less well. Made to be believed, they changed the error 0.2 s ahead by -2 to +3 %.
The logs' missions, told twice a second with braking as it was flown, changed what is misapplied on
q116 from 2.91 to 2.84 % and on q130 from 4.61 to 4.64 %, less than the spread of three flights. So
neither is asked for by default.
"""
CASES = (
    "", "velocity", "place", "velocity place nose", "often", "alike", "alike often", "inertial",
)  # fmt: skip


def given(bed: Bed, what: str) -> Bed:
    """Return the bed with some of the truth told, or with valves that are alike."""
    told, profile = bed.told.copy(), bed.profile
    if "often" in what:
        at_s = np.arange(bed.path.time_s[0], bed.path.time_s[-1], 1.0 / OFTEN_HZ)
        rows = [np.interp(at_s, told.time_s, told[name]) for name in told.dtype.names]
        told = rows_of([at_s, *rows[1:]])
    true = bed.path.at(told.time_s)
    if "velocity" in what or "often" in what:
        told.north_m_s, told.east_m_s = true.velocity_north_m_s, true.velocity_east_m_s
    if "place" in what or "often" in what:
        earth = Earth(bed.setup.frame.latitude_deg, bed.setup.frame.longitude_deg)
        places = earth.to_geographic_all(true.east_m, true.north_m)
        told.latitude_deg, told.longitude_deg = places
    if "nose" in what or "often" in what:
        told.heading_deg = true.heading_deg % 360.0
    if "alike" in what:
        profile = replace(profile, lag_scatter=0.0, flow_scatter=0.0)
    return replace(bed, told=told, profile=profile)


def inertial(bed: Bed, log: Path) -> list[Input]:
    """Return attitude (10 Hz) and accelerometer (25 Hz) as the log's autopilot had them."""
    from pymavlink import DFReader

    start_s, end_s = bed.path.time_s[[0, -1]].tolist()
    found: list[Input] = []
    turns = (0.0, 0.0, 0.0)
    reader: Any = DFReader.DFReader_binary(str(log))
    while (row := reader.recv_match(type=["IMU", "ATT"])) is not None:
        at_s = row.TimeUS * 1e-6
        when: dict[str, float] = {
            "received_s": at_s + LATE_S,
            "boot_s": math.floor(at_s * 1e3) / 1e3,
        }
        if row.get_type() == "IMU" and row.I == 0:
            turns = row.GyrX, row.GyrY, row.GyrZ
            imu = ImuReport(**when, forward_m_s2=row.AccX, right_m_s2=row.AccY, down_m_s2=row.AccZ)
            found += [imu] * (start_s < at_s < end_s)
        elif row.get_type() == "ATT":
            roll, pitch, yaw = (math.degrees(rate) for rate in turns)
            attitude = AttitudeReport(
                **when, roll_deg=row.Roll, pitch_deg=row.Pitch, yaw_deg=row.Yaw,
                roll_rate_deg_s=roll, pitch_rate_deg_s=pitch, yaw_rate_deg_s=yaw,
            )  # fmt: skip
            found += [attitude] * (start_s < at_s < end_s)
    reader.filehandle.close()
    return found


def closed(log: Path, beds: Sequence[Bed], what: str, method: str = "vrspray") -> str:
    """Fly some flights and return their figures as a line."""
    rows = []
    for seed, bed in enumerate(beds, start=1):
        more = inertial(bed, log) if what == "inertial" else []

        def listened(bed: Bed, seed: int, more: Iterable[Input] = more) -> Iterable[Input]:
            return heapq.merge(heard(bed, seed), more, key=lambda item: item.received_s)

        with patch.object(sitl.along, "heard", listened):
            flown = given(bed, what)
            rows.append(figures_of(flown, fly_method(flown, method, seed)))
    row = row_of(method, rows)
    texts = [
        "-" if row[name] is None else f"{row[name]['mean']:.2f}"
        for name in ("misapplied_percent", "turn_misapplied_percent")
    ]
    lag = row["lag_distance_m"]["median_abs"]
    return f"| {log.stem} | {method} | {what or 'as told'} | {' | '.join(texts)} | {lag:.3f} |"


def foretold(log: Path, bed: Bed, *, with_inertia: bool) -> str:
    """Return how far off the speed is that is foretold, open loop."""
    states, track = bed.flight.states, Track()
    more = inertial(bed, log) if with_inertia else []
    off: dict[float, list[float]] = {lead_s: [] for lead_s in LEADS_S}
    for item in heapq.merge(heard(bed, 1), more, key=lambda item: item.received_s):
        track = observe(track, item, bed.setup)
        if not isinstance(item, Telemetry):
            continue
        for lead_s in LEADS_S:
            at_s = item.boot_s + lead_s
            state = estimate(track, at_s)
            if state is None or not states.time_s[0] + 3.0 < at_s < states.time_s[-1]:
                continue
            east = float(np.interp(at_s, states.time_s, states.east_m_s))
            north = float(np.interp(at_s, states.time_s, states.north_m_s))
            speed = math.hypot(east, north)
            if speed > MOVING_M_S:
                along = state.velocity_east_m_s * east + state.velocity_north_m_s * north
                off[lead_s].append(along / speed - speed)
    cells = " | ".join(f"{math.sqrt(np.mean(np.square(each))):.4f}" for each in off.values())
    return f"| {log.stem} | {'with inertia' if with_inertia else 'positions alone'} | {cells} |"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--page", action="store_true", help=f"write docs/measurements/{PAGE.name}")
    asked = parser.parse_args()
    lines = ["| Log | Method | Given | Misapplied [%] | In turns [%] | Lag [m] |", "|---" * 6 + "|"]
    opened = [f"| Log | Heard | {' | '.join(f'{s:g} s ahead [m/s]' for s in LEADS_S)} |"]
    opened.append("|---" * 5 + "|")
    for log in asked.logs:
        options = AlongOptions(log=log, position_rate_hz=RATE_HZ)
        beds = [prepare(replace(options, seed=seed)) for seed in range(1, asked.flights + 1)]
        lines += [closed(log, beds, what) for what in CASES]
        lines += [closed(log, beds, what, "perfect") for what in ("", "alike")]
        opened += [foretold(log, beds[0], with_inertia=each) for each in (False, True)]
    sys.stdout.write("\n".join([*lines, "", *opened]) + "\n")
    if asked.page:
        today = datetime.now(tz=UTC).date().isoformat()
        tables = {"closed": "\n".join(lines), "opened": "\n".join(opened)}
        PAGE.write_text(PAGE_TEXT.format(today=today, **tables), "utf-8")


if __name__ == "__main__":
    main()

"""Makes the missions of this folder: four passes through the centres of the plots at 5 m/s.

3.5 m above home, 15 m of run-out at each end, so that no turn happens over the field. The same
flight twice: `mission.waypoints` (QGC WPL 110) and `mission.plan` (QGroundControl). Run it again
and nothing changes: `python examples/anyang/make_mission.py [FOLDER]`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from sitl.anyang import anyang_items
from sitl.calibration_mission import write_mission

SPEED_M_S = 5.0


def main(folder: Path) -> None:
    """Write the missions of the example."""
    write_mission(anyang_items(SPEED_M_S), folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)

"""Of batteries, several aircraft and a break: from configuration and files to what plans need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from shapely import MultiPolygon
from shapely.affinity import translate
from shapely.geometry.base import BaseGeometry

from companion.config.tables import MissionTable
from companion.core.frame import LocalFrame
from companion.journal.continuing import is_journal, read_treated_ground, rest_of
from companion.journal.coverage import carried, carried_places
from missions.energy import Battery
from missions.errors import PlanError
from missions.field import MARGIN_M, Field, local_area
from missions.maps.local import as_area, polygons_of
from missions.maps.registry import read_area
from missions.reading_outline import told
from missions.remaining import Break, Remaining, read_lines, remaining
from missions.strips import Floats

OVERLAP_M = 3.0
# How rough the edge of treated ground is: gusts of 0.3 m.
EDGE_M = 0.3
# In squares as wide as a swath.
SMALL_SWATHS = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class BreakAsked:
    """What the command line says of a break; `stop` is (latitude, longitude)."""

    done: Path | None = None
    resume: Path | None = None
    stop: tuple[float, float] | None = None
    sortie: int | None = None

    def __post_init__(self) -> None:
        if self.resume is None and (self.stop is not None or self.sortie is not None):
            raise PlanError("--from and --sortie need --resume, the .geojson of the plan to go on")
        if self.resume is None or is_journal(self.resume):
            return
        if self.stop is None and self.done is None:
            raise PlanError(
                "--resume needs --from LAT,LON, where the spraying stopped, or --done, "
                "the treated ground"
            )

    @property
    def ground(self) -> Path | None:
        """Return the file of the treated ground: that of --done, or a journal to go on with."""
        if self.done is None and self.resume is not None and is_journal(self.resume):
            return self.resume
        return self.done


NO_BREAK = BreakAsked()
# How a journal without lines is refused: who goes on from one may leave it at its ground.
NO_LINES = "its flight had no planned lines"


def fleet_settings(mission: MissionTable) -> dict[str, Any]:
    """Return the settings that [mission] gives for power, ground times and several aircraft."""
    return {
        "battery": battery_of(mission),
        "refill_s": mission.refill_s,
        "swap_s": mission.swap_s,
        "nose_rate_deg_s": mission.nose_rate_deg_s,
        "aircraft": mission.aircraft,
        "aircraft_gap_m": mission.aircraft_gap_m,
    }


def battery_of(mission: MissionTable) -> Battery | None:
    """Return the battery; None where no power is given."""
    hover_w = mission.power_hover_w
    if hover_w is None:
        if mission.battery_wh is not None or mission.power_cruise_w is not None:
            raise PlanError("mission.power_hover_w is missing: the power with an empty tank, in W")
        return None
    cruise_w = mission.power_cruise_w
    return Battery(
        hover_w=hover_w,
        cruise_w=hover_w if cruise_w is None else cruise_w,
        per_kg_w=mission.power_per_kg_w,
        capacity_wh=mission.battery_wh,
        reserve_percent=mission.battery_reserve_percent,
    )


def left_of(
    asked: BreakAsked,
    mission: MissionTable | None,
    frame: LocalFrame,
    *,
    width_m: float,
    offset_m: tuple[float, float],
    opens: Mapping[str, str | None],
) -> Remaining | None:
    """Return what a plan that is gone on with leaves; None without one.

    The places of the plan and of the stop are the receiver's; treated ground is moved as the map.
    """
    if asked.resume is None:
        return None
    is_flown = is_journal(asked.resume)
    rows = _flown_lines(asked.resume, frame) if is_flown else read_lines(asked.resume, frame)
    done = asked.ground
    treated = None if done is None else treated_area(done, frame, width_m, offset_m, opens=opens)
    since = Break(
        stop=None if asked.stop is None else frame.to_local(*asked.stop),
        sortie=asked.sortie,
        overlap_m=OVERLAP_M if mission is None else mission.resume_overlap_m,
        treated=treated,
    )
    return remaining(rows, since, width_m=width_m, frame=frame)


def _flown_lines(journal: Path, frame: LocalFrame) -> list[tuple[int, Floats]]:
    """Return the planned lines that a flight had to keep to, straight piece by straight piece.

    Raises:
        PlanError: where it had none.
    """
    found = read_treated_ground(journal)
    if found.setup.lines is None:
        raise PlanError(
            f"{journal}: {NO_LINES}; give the plan's .geojson to --resume and the journal to --done"
        )
    pieces = [piece for line in found.setup.lines.polylines for piece in pairwise(line)]
    places = np.array(pieces, dtype=np.float64).reshape(-1, 2)
    return [(1, row) for row in carried_places(places, found.frame, frame).reshape(-1, 4)]


def treated_area(
    done: Path,
    frame: LocalFrame,
    width_m: float,
    offset_m: tuple[float, float],
    *,
    opens: Mapping[str, str | None],
) -> BaseGeometry:
    """Return the treated ground of a file; of a journal all that is not left of its own field.

    A journal's places are the receiver's, as the plan's are; an area is moved as the map. Its edge
    is as rough as the flight was: swaths may overlap it a little, the guard of a flight that goes
    on closes what is too much. Nobody flies for pieces much smaller than a swath is wide.
    """
    if not is_journal(done):
        return translate(
            local_area(told(partial(read_area, done, nested=True), opens), frame), *offset_m
        )
    found = read_treated_ground(done)
    field = found.setup.prescription.field
    left = rest_of(field, found.coverage, found.strip_m)
    small_m2 = SMALL_SWATHS * width_m**2
    flown = [piece for piece in left.geoms if piece.area >= small_m2]
    edge = field.difference(MultiPolygon(flown)).buffer(-EDGE_M).simplify(EDGE_M)
    return carried(edge, found.frame, frame)


def untreated(
    field: Field,
    done: Path,
    width_m: float,
    offset_m: tuple[float, float],
    *,
    opens: Mapping[str, str | None],
) -> Field:
    """Return the field without the treated ground: it is flown over, and not sprayed again.

    Raises:
        PlanError: where nothing is left that a strip fits on.
    """
    treated = treated_area(done, field.frame, width_m, offset_m, opens=opens)
    kept = treated.buffer(MARGIN_M, join_style="mitre")
    spray = as_area(polygons_of(field.spray.difference(kept)))
    if spray is None or spray.buffer(-width_m / 2.0).is_empty:
        raise PlanError(f"{done}: it leaves nothing of the field that is as wide as the swath")
    return replace(field, spray=spray, limit=field.limit.difference(treated))

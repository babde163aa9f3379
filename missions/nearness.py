"""Whether what a task names lies near its field; a forgotten sign puts it on another continent."""

from __future__ import annotations

from companion.core.frame import WGS84, LocalFrame
from missions.errors import PlanError

# Fields are refused beyond 20 km of extent, and so are depots beyond as much: this is no field's.
FAR_M = 50_000.0


def check_near(what: str, latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> None:
    """Refuse what lies far from the field, and say when one sign would bring it there.

    Raises:
        PlanError: naming `what` and where it lies.
    """
    far_m = _far_m(latitude_deg, longitude_deg, frame)
    if far_m <= FAR_M:
        return
    for name, lat, lon in (
        ("latitude", -latitude_deg, longitude_deg),
        ("longitude", latitude_deg, -longitude_deg),
        ("latitude and longitude", -latitude_deg, -longitude_deg),
    ):
        if _far_m(lat, lon, frame) <= FAR_M:
            fix = f"its {name} is of the wrong hemisphere: change the sign"
            break
    else:
        swapped = abs(longitude_deg) <= 90.0 and _far_m(longitude_deg, latitude_deg, frame) <= FAR_M
        fix = "latitude and longitude are swapped" if swapped else "is it of another field?"
    raise PlanError(
        f"{what} lies at {latitude_deg:.4f}, {longitude_deg:.4f}, {far_m / 1000.0:.0f} km from the "
        f"field at {frame.latitude_deg:.4f}, {frame.longitude_deg:.4f}; {fix}"
    )


def _far_m(latitude_deg: float, longitude_deg: float, frame: LocalFrame) -> float:
    """Return the distance to the field's middle; infinite for what is no place."""
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        return float("inf")
    _, _, far_m = WGS84.inv(longitude_deg, latitude_deg, frame.longitude_deg, frame.latitude_deg)
    return float(far_m)

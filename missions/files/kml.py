"""The whole plan as KML, to look at: a folder for each sortie, a colour for each kind of leg.

With an elevation model heights are above sea level, as the model has them; without one they are
above whatever ground the viewer knows, because nothing says how high the depot is.
"""

from __future__ import annotations

from xml.sax.saxutils import escape

from missions.plan import Leg, Place, Plan

# Alpha, blue, green, red.
COLOURS = {"spray": "ff3ca03c", "transit": "ff00a5ff", "ferry": "ff3232dc"}


def kml_text(plan: Plan) -> str:
    """Return the content of the file."""
    styles = [
        f'<Style id="{kind}"><LineStyle><color>{colour}</color><width>2</width></LineStyle></Style>'
        for kind, colour in COLOURS.items()
    ]
    folders = [
        f"<Folder><name>{escape(f'Sortie {sortie.number}: {sortie.volume_l:.1f} L')}</name>"
        + "".join(_leg(plan, leg) for leg in sortie.legs if leg.length_m > 0.0)
        + "</Folder>"
        for sortie in plan.sorties
    ]
    depots = [
        f"<Placemark><name>Depot {number}</name><Point><coordinates>{_place(plan, depot)}"
        "</coordinates></Point></Placemark>"
        for number, depot in enumerate(plan.depots, start=1)
    ]
    body = "\n".join([*styles, *folders, *depots])
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n{body}\n</Document></kml>\n'
    )


def _place(plan: Plan, place: Place) -> str:
    latitude_deg, longitude_deg = plan.frame.to_geographic(*place)
    return f"{longitude_deg:.9f},{latitude_deg:.9f}"


def _leg(plan: Plan, leg: Leg) -> str:
    height_m = plan.settings.height_m if leg.height_m is None else leg.height_m
    if plan.terrain is None:
        mode, heights = "relativeToGround", [(place, height_m) for place in leg.points]
    else:
        way = plan.terrain.straight_parts(leg.points)
        mode = "absolute"
        heights = [
            ((east_m, north_m), ground_m + height_m)
            for (east_m, north_m), ground_m in zip(
                way.places.tolist(), way.ground_m.tolist(), strict=True
            )
        ]
    line = " ".join(f"{_place(plan, place)},{above_m:.2f}" for place, above_m in heights)
    return (
        f"<Placemark><name>{leg.kind}</name><styleUrl>#{leg.kind}</styleUrl>"
        f"<LineString><altitudeMode>{mode}</altitudeMode>"
        f"<coordinates>{line}</coordinates></LineString></Placemark>"
    )

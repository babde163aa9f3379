"""What the page knows of the flight: the newest frame, the way that was sprayed, and sums of it.

The way is a list of points, one a metre and one at each change of a valve. All browsers are given
the same list, so they agree; a browser that slept asks for what it missed. The list is kept in a
file, so a companion that restarts shows the flight so far.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from companion.core.boom import body_axes
from companion.core.frame import metres_per_degree
from companion.core.options.coverage import Coverage, Quad
from companion.core.types import Inhibit, SprayerState

POINT_EVERY_M = 1.0
# A gap in time or a jump of the position is no way that was flown.
GAP_S, JUMP_M = 1.5, 30.0
# 200 km at one point a metre: more than a day of flights.
POINTS_MAX = 200_000
# An older way is of another day.
KEEP_S = 12 * 3600.0
METER_WINDOW_S = 1.0

# What to do about each reason not to spray; its words are its own.
ADVICE: dict[Inhibit, str] = {
    Inhibit.ESTOP: "Make sure all is safe, then hold Release stop.",
    Inhibit.REARM_NEEDED: "Find the cause. Then hold Release, and enable again.",
    Inhibit.NOT_ENABLED: "Hold Enable, or use the RC switch or the ground station.",
    Inhibit.NO_POSITION: "Check the link and the GNSS receiver.",
    Inhibit.STALE_POSITION: "The link is slow or lossy: check cable, radio and baud rate.",
    Inhibit.INVALID_POSITION: "Wait some seconds; if it stays, land and check the GNSS.",
    Inhibit.POSITION_FROZEN: "Positions repeat: check the autopilot's estimator.",
    Inhibit.CLOCK_DISAGREES: "Wait for the clocks to agree; if it stays, restart the companion.",
    Inhibit.FAR_FROM_FIELD: "Is this the right map for this field?",
    Inhibit.NO_HEARTBEAT: "Check the link to the autopilot.",
    Inhibit.STALE_HEARTBEAT: "Check the link to the autopilot.",
    Inhibit.NOT_ARMED: "Arm the vehicle for the mission.",
    Inhibit.NOT_ACTIVE: "The autopilot reports a failsafe: see the ground station.",
    Inhibit.WRONG_MODE: "Switch to a mode in safety.modes, usually AUTO.",
    Inhibit.NOT_IN_AIR: "Take off.",
    Inhibit.FIX_TOO_LOW: "Wait for RTK; check corrections and antenna.",
    Inhibit.ACCURACY_TOO_LOW: "Wait for a better GNSS solution.",
    Inhibit.ESTIMATOR_UNHEALTHY: "See the EKF report on the ground station; land if it stays.",
    Inhibit.HEADING_UNKNOWN: "Check the compass or the dual-antenna heading.",
    Inhibit.SPEED_UNKNOWN: "Check the GNSS receiver.",
    Inhibit.SPEED_BELOW_MIN: "Opens again at speed.",
    Inhibit.SPEED_ABOVE_MAX: "Fly slower.",
    Inhibit.SPEED_DISAGREES: "Two speeds disagree: land and check the GNSS.",
    Inhibit.SPEED_UNCHECKED: "The autopilot does not send VFR_HUD.",
    Inhibit.HEIGHT_BELOW_MIN: "Opens again at height.",
    Inhibit.HEIGHT_ABOVE_MAX: "Fly lower.",
    Inhibit.WIND_ABOVE_MAX: "Wait for the wind to drop.",
    Inhibit.WIND_UNKNOWN: "Send the wind from the ground station.",
    Inhibit.LABEL_SPEED: "Fly at the speed that the label allows.",
    Inhibit.LABEL_HEIGHT: "Fly at the height that the label allows.",
    Inhibit.LABEL_WIND: "Wait for the wind that the label allows; it must be measured.",
    Inhibit.LABEL_WIND_DIRECTION: "Wait for the wind to turn; its direction must be measured.",
    Inhibit.LABEL_TIME: "Wait for the label's hours; the autopilot must know the time.",
    Inhibit.LABEL_WEATHER_AGE: "Observe the weather again, and declare it under Weather and label.",
    Inhibit.LABEL_TEMPERATURE: "Measure it, and declare it under Weather and label.",
    Inhibit.LABEL_HUMIDITY: "Measure it, and declare it under Weather and label.",
    Inhibit.LABEL_INVERSION: "Look for one, and declare what you see under Weather and label.",
    Inhibit.LABEL_DROPLETS: "Fit nozzles of the label's class, and declare it.",
    Inhibit.RC_SWITCH: "Turn the spray switch on the transmitter on.",
    Inhibit.OUTPUT_FAULT: "Do not spray. Land, then run vrspray doctor.",
    Inhibit.LINK_LOST: "Check the link to the autopilot.",
    Inhibit.UNGUARDED: "Install the watchdog script, or fit a board: docs/safety.md.",
    Inhibit.LEAK: "Liquid flows with all valves closed: land and look for the leak.",
    Inhibit.VALVE_STUCK_OPEN: "Land and check the valve.",
    Inhibit.NO_FLOW: "Check pump, tank and hoses.",
    Inhibit.TANK_EMPTY: "Land and refill.",
    Inhibit.FLOW_FAULT: "Check the flow meter and the liquid's way.",
}
# What only the flight itself can satisfy is no alarm on the ground.
_WAITING = frozenset(
    {
        Inhibit.NOT_ENABLED,
        Inhibit.NOT_ARMED,
        Inhibit.NOT_IN_AIR,
        Inhibit.WRONG_MODE,
        Inhibit.SPEED_BELOW_MIN,
        Inhibit.HEIGHT_BELOW_MIN,
        Inhibit.HEIGHT_ABOVE_MAX,
        Inhibit.LABEL_SPEED,
        Inhibit.LABEL_HEIGHT,
        Inhibit.RC_SWITCH,
    }
)
_WORDS = {
    SprayerState.BOOT: "WAITING",
    SprayerState.SAFE: "NOT READY",
    SprayerState.READY: "READY",
    SprayerState.ARMED: "ENABLED",
    SprayerState.SPRAYING: "SPRAYING",
    SprayerState.FAULT: "FAULT",
    SprayerState.ESTOP: "STOPPED",
}
# In the air it may spray, and holds: nothing is prescribed here, or it is too slow or too high.
_HOLD = "HOLD"
_OUTSIDE_LINE = "Outside the map: valves open over a zone."
_ENABLED_LINE = "Valves open when the vehicle is over a zone, at speed and height."


def reasons_of(codes: Sequence[str]) -> list[dict[str, Any]]:
    """Return the reasons not to spray, each with what to do, the gravest first."""
    given = frozenset(codes)
    found = [
        {
            "code": reason.value,
            "text": reason.words,
            "advice": ADVICE[reason],
            "is_alarm": reason not in _WAITING,
        }
        for reason in Inhibit
        if reason.value in given
    ]
    return sorted(found, key=lambda one: not one["is_alarm"])


@dataclass(slots=True)
class BoomTrace:
    """Where the boom went and with which valves open; sums of area and volume."""

    valves: tuple[tuple[float, float, float], ...]  # right, forward, width [m]
    points: list[list[Any]] = field(default_factory=list)
    coverage: Coverage = field(default_factory=Coverage)
    volume_l: float = 0.0
    _last: tuple[float, float] | None = None  # time, flow

    def take(self, frame: dict[str, Any]) -> list[Any] | None:
        """Take a frame; return the point that it adds, if it adds one."""
        now_s, flow = float(frame["now_s"]), frame.get("flow_l_min") or 0.0
        if self._last is not None and 0.0 < now_s - self._last[0] < GAP_S:
            self.volume_l += self._last[1] / 60.0 * (now_s - self._last[0])
        self._last = (now_s, flow)
        vehicle = frame.get("vehicle") or {}
        east, north = vehicle.get("east_m"), vehicle.get("north_m")
        heading = vehicle.get("heading_deg")
        if east is None or north is None or heading is None or not vehicle.get("in_air"):
            return None
        duty = frame.get("duty") or []
        bits = "".join("1" if share > 0.0 else "0" for share in duty)
        rate, wanted = actual_rate(frame, self.valves), wanted_rate(frame, self.valves)
        return self.add([round(now_s, 2), east, north, heading, bits, rate, wanted])

    def add(self, point: list[Any]) -> list[Any] | None:
        """Add a point where it is news; return it then."""
        is_open = "1" in point[4]
        if self.points:
            last = self.points[-1]
            gone_m = math.hypot(point[1] - last[1], point[2] - last[2])
            if point[4] == last[4] and (gone_m < POINT_EVERY_M or not is_open):
                return None
            joined = gone_m <= JUMP_M and 0.0 <= point[0] - last[0] <= GAP_S + gone_m
            if joined and "1" in last[4]:
                self._stamp(last, point)
        elif not is_open:
            return None
        if len(self.points) >= POINTS_MAX:
            return None
        self.points.append(point)
        return point

    def _stamp(self, last: list[Any], point: list[Any]) -> None:
        quads = list(quads_between(self.valves, last, point))
        self.coverage = self.coverage.stamped(quads)

    @property
    def area_ha(self) -> float:
        """Return the ground that was sprayed, each place once."""
        return self.coverage.area_m2 / 10_000.0


def quads_between(
    valves: Sequence[tuple[float, float, float]], last: list[Any], point: list[Any]
) -> list[Quad]:
    """Return the ground swept between two points by the valves that were open at the first."""
    found: list[Quad] = []
    for index, (right_m, forward_m, width_m) in enumerate(valves):
        if index >= len(last[4]) or last[4][index] != "1":
            continue
        a, b = (
            _end(last, right_m - width_m / 2, forward_m),
            _end(last, right_m + width_m / 2, forward_m),
        )
        d, c = (
            _end(point, right_m - width_m / 2, forward_m),
            _end(point, right_m + width_m / 2, forward_m),
        )
        found.append((a, b, c, d))
    return found


def _end(point: list[Any], right_m: float, forward_m: float) -> tuple[float, float]:
    forward, right = body_axes(point[3])
    return (
        point[1] + forward[0] * forward_m + right[0] * right_m,
        point[2] + forward[1] * forward_m + right[1] * right_m,
    )


# A browser takes over what its worker has read in one go: of more zones it would stand still.
ZONES_AT_ONCE = 4000


def map_parts(ground: dict[str, Any]) -> tuple[dict[str, Any], list[Any], list[dict[str, Any]]]:
    """Return the map without its zones, the zones in metres, and the zones as GeoJSON in parts.

    Places are as the page's own script works them out, good to 0.1 m in a kilometre: all that is
    drawn lies on each other.
    """
    zones = ground["zones"]
    rates = sorted({zone["rate_l_ha"] for zone in zones})
    summary = {key: value for key, value in ground.items() if key != "zones"}
    latitude_deg, longitude_deg = (
        ground["origin"]["latitude_deg"],
        ground["origin"]["longitude_deg"],
    )
    m_per_longitude, m_per_latitude = metres_per_degree(latitude_deg)

    def places(ring: list[float]) -> list[list[float]]:
        found = [
            [
                round(longitude_deg + east_m / m_per_longitude, 8),
                round(latitude_deg + north_m / m_per_latitude, 8),
            ]
            for east_m, north_m in zip(ring[::2], ring[1::2], strict=True)
        ]
        return found if found[0] == found[-1] else [*found, found[0]]

    features = [
        {
            "type": "Feature",
            "properties": {"zone": number, "rate": zone["rate_l_ha"]},
            "geometry": {
                "type": "MultiPolygon",
                "coordinates": [[places(ring) for ring in area] for area in zone["areas"]],
            },
        }
        for number, zone in enumerate(zones)
    ]
    places_of = [
        {"type": "FeatureCollection", "features": features[first : first + ZONES_AT_ONCE]}
        for first in range(0, max(len(features), 1), ZONES_AT_ONCE)
    ]
    counts = {"zone_count": len(zones), "zone_parts": len(places_of)}
    return summary | counts | {"rates_l_ha": rates}, zones, places_of


def actual_rate(
    frame: dict[str, Any], valves: Sequence[tuple[float, float, float]]
) -> float | None:
    """Return what is applied now in L/ha, by the ordered flow over the open width; None: nothing.

    Q [L/min] = rate [L/ha] x width [m] x speed [m/s] x 60 / 10,000.
    """
    speed = (frame.get("vehicle") or {}).get("speed_m_s")
    duty, flow = frame.get("duty") or [], frame.get("flow_l_min")
    width_m = sum(valve[2] for valve, share in zip(valves, duty, strict=False) if share > 0.0)
    if speed is None or flow is None or not (speed > 0.2 and width_m > 0.0):
        return None
    return round(float(flow) * 10_000.0 / (60.0 * width_m * float(speed)), 1)


def wanted_rate(
    frame: dict[str, Any], valves: Sequence[tuple[float, float, float]]
) -> float | None:
    """Return what the map asks for under the open valves in L/ha, by width; None: nothing."""
    duty, rates = frame.get("duty") or [], frame.get("rates_l_ha") or []
    open_ = [
        (valve[2], rate)
        for valve, share, rate in zip(valves, duty, rates, strict=False)
        if share > 0.0 and rate is not None
    ]
    width_m = sum(width for width, _ in open_)
    return round(sum(width * rate for width, rate in open_) / width_m, 1) if width_m else None


class Live:
    """The newest state for all browsers."""

    def __init__(self, about: dict[str, Any], *, way_file: Path | None, utc_s: float) -> None:
        ground = about["map"]
        valves = tuple(
            (valve["right_m"], valve["forward_m"], valve["width_m"])
            for valve in ground["boom"]["valves"]
        )
        self.way = BoomTrace(valves)
        self.field_m2 = float(ground["field_m2"])
        self.state: dict[str, Any] = {}
        self.version = 0
        self.urgent = 0
        self._meter: list[tuple[float, float]] = []
        self._since_s: dict[str, float] = {}
        self._file: IO[str] | None = None
        self.way_id = round(utc_s, 1)
        self._way_file, self._begun_s = way_file, (utc_s, time.monotonic())
        # Water, dry runs and simulated vehicles have a way of their own: it is not what the product
        # covered. Of the vehicle one hears only later.
        self._is_simulated = False
        self._key = f"{ground['sha256']} {len(valves)} {about['facts']['training']}"
        if way_file is not None:
            self._resume(way_file, utc_s)

    def take(self, payload: bytes) -> None:
        """Take a frame from the control loop."""
        frame = json.loads(payload)
        self._mark(frame)
        point = self.way.take(frame)
        if point is not None:
            self._keep(point)
        self.version += 1
        if frame.pop("urgent", False):
            self.urgent = self.version
        frame["meter_l_min"] = self._metered(frame.get("liquid") or {})
        is_held = frame["state"] == SprayerState.ARMED and (frame.get("vehicle") or {}).get(
            "in_air"
        )
        frame["word"] = _HOLD if is_held else _WORDS[SprayerState(frame["state"])]
        frame["reasons"] = reasons_of(frame.pop("inhibits", ()))
        self._date(frame)
        frame["line"] = self._line(frame)
        frame["actual_l_ha"] = actual_rate(frame, self.way.valves)
        rates = [rate for rate in frame.get("rates_l_ha") or [] if rate]
        frame["target_l_ha"] = round(sum(rates) / len(rates), 1) if rates else None
        frame["area_ha"] = round(self.way.area_ha, 4)
        frame["left_ha"] = round(max(self.field_m2 / 10_000.0 - self.way.area_ha, 0.0), 4)
        frame["volume_l"] = round(self.way.volume_l, 3)
        frame["point_count"] = len(self.way.points)
        self.state = frame

    def _mark(self, frame: dict[str, Any]) -> None:
        """Begin the way anew where the one so far is of simulated flights and this is none.

        Or the reverse. A vehicle that says nothing of itself is real once it flies.
        """
        is_simulated = bool(frame.get("simulated"))
        is_known = is_simulated or bool((frame.get("vehicle") or {}).get("in_air"))
        if is_simulated == self._is_simulated or not is_known:
            return
        self._is_simulated = is_simulated
        self.way = BoomTrace(self.way.valves)
        utc_s, begun_s = self._begun_s
        self.way_id = round(utc_s + time.monotonic() - begun_s, 1)
        self.close()
        if self._way_file is not None:
            self._open(self._way_file)

    def _date(self, frame: dict[str, Any]) -> None:
        """Say since when each reason and alarm holds, on the clock of the frames."""
        dated = {f"reason {one['code']}": one for one in frame["reasons"]}
        for one in frame.get("findings") or []:
            dated[f"finding {one['kind']} {one['valve']}"] = one
        others = {
            "record": (frame.get("journal") or {}).get("fault"),
            "range": frame.get("out_of_range"),
        }
        holding = [*dated, *(name for name, is_so in others.items() if is_so)]
        self._since_s = {name: self._since_s.get(name, frame["now_s"]) for name in holding}
        for name, one in dated.items():
            one["since_s"] = self._since_s[name]
        frame["since_s"] = {name: self._since_s[name] for name in others if name in self._since_s}

    def _line(self, frame: dict[str, Any]) -> str:
        if frame["state"] == SprayerState.SPRAYING.value:
            return ""
        if not frame["reasons"]:
            is_outside = frame["word"] == _HOLD and all(
                rate is None for rate in frame.get("rates_l_ha") or [0.0]
            )
            return _OUTSIDE_LINE if is_outside else _ENABLED_LINE
        return ", ".join(reason["text"] for reason in frame["reasons"][:3])

    def _metered(self, liquid: dict[str, Any]) -> float | None:
        """Return the meter's flow, a mean over a second."""
        volume_ml, at_s = liquid.get("meter_ml"), liquid.get("meter_s")
        if volume_ml is None or at_s is None:
            self._meter.clear()
            return None
        if not self._meter or at_s > self._meter[-1][0]:
            self._meter.append((at_s, volume_ml))
        while len(self._meter) > 2 and at_s - self._meter[1][0] >= METER_WINDOW_S:
            self._meter.pop(0)
        first_s, first_ml = self._meter[0]
        if not at_s - first_s > 0.2:
            return None
        return round((float(volume_ml) - first_ml) / 1000.0 / (float(at_s) - first_s) * 60.0, 2)

    # ------------------------------------------------------------------------- kept in a file

    def close(self) -> None:
        """Let go of the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _resume(self, path: Path, utc_s: float) -> None:
        """Read the way so far where it is of this map and of today, and go on with it."""
        bad = (OSError, ValueError, KeyError, TypeError, IndexError)
        with suppress(*bad), path.open(encoding="utf-8") as file:
            head = json.loads(file.readline(1000))
            if head["key"] == self._key and 0.0 <= utc_s - head["utc_s"] <= KEEP_S:
                self.way_id = float(head["utc_s"])
                self._is_simulated = bool(head["simulated"])
                self._read(file)
        if not self.way.points:
            self.way_id, self._is_simulated = round(utc_s, 1), False
        self._open(path)

    def _open(self, path: Path) -> None:
        """Go on in the file, or begin it; without one the page works as well."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a" if self.way.points else "w", encoding="utf-8")
        except OSError:
            self._file = None
        if not self.way.points:
            head = {"key": self._key, "utc_s": self.way_id, "simulated": self._is_simulated}
            self._write(head)

    def _read(self, file: IO[str]) -> None:
        for line in file:
            with suppress(ValueError, TypeError, IndexError):
                point = json.loads(line)
                if len(point) == 8 and isinstance(point[4], str):
                    self.way.volume_l = float(point.pop())
                    self.way.add([float(number) for number in point[:4]] + point[4:])

    def _keep(self, point: list[Any]) -> None:
        self._write([*point, round(self.way.volume_l, 3)])

    def _write(self, item: object) -> None:
        if self._file is not None:
            with suppress(OSError):
                self._file.write(json.dumps(item) + "\n")
                self._file.flush()

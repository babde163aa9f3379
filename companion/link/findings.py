"""What is wrong with a link, from what is seen of it: one line with what to change.

Pure: counts and times in, words out. A reason that holds is found within `PATIENCE_S` of the
link's coming up, well inside the five seconds that an operator waits.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.link.census import Census, Vehicle
from companion.link.transport import LinkUrl

PATIENCE_S = 2.0
# Three heartbeats that did not come; an answer is there within a tenth of a second, or lost.
QUIET_S = 3.0
# Noise of a wire that hangs loose is a few bytes; a wrong baud rate turns every frame into some.
_NOISE_BYTES = 64
_KNOWN = {0: "generic", 4: "OpenPilot", 13: "SmartAP", 14: "AirRails", 15: "ReflexV"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What is seen and what to do; `short` fits the operator's screen (43 characters)."""

    text: str
    short: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What has come in since the link came up, `up_s` ago."""

    up_s: float
    byte_count: int
    frame_count: int
    refused_count: int
    # How long ago the streams were asked for without any answer; None once one came.
    asked_s: float | None
    now_s: float


def blocking(census: Census, now_s: float) -> Finding | None:
    """Return why nothing may open whatever else holds: two vehicles, or one we cannot know."""
    rivals = census.rivals(now_s)
    vehicle = census.vehicle
    if vehicle is None:
        return None
    if rivals:
        numbers = sorted({*rivals[:5], vehicle.system_id})
        systems = ", ".join(map(str, numbers))
        first = ",".join(map(str, numbers[:2])) + (".." if len(numbers) > 2 else "")
        return Finding(
            text=f"two autopilots or more on this link, systems {systems}: set link.system_id to "
            "the one that carries this sprayer and restart",
            short=f"autopilots {first}: set link.system_id",
        )
    if not (vehicle.is_ardupilot or vehicle.is_px4):
        name = _KNOWN.get(vehicle.autopilot, "unknown")
        return Finding(
            text=f"system {vehicle.system_id} runs firmware {vehicle.autopilot} ({name}), neither "
            "ArduPilot nor PX4: set link.system_id to another vehicle, or change the firmware",
            short=f"firmware {vehicle.autopilot}: no ArduPilot or PX4",
        )
    return None


def find(url: LinkUrl, census: Census, seen: Seen) -> Finding | None:
    """Return what keeps the vehicle from being heard; None while all is well, or too early."""
    if not seen.up_s >= PATIENCE_S:
        return None
    if seen.frame_count == 0:
        return _nothing_usable(url, seen)
    if census.vehicle is None:
        return _no_vehicle(url, census, seen.now_s)
    return _vehicle_quiet(url, census, census.vehicle, seen)


def _vehicle_quiet(url: LinkUrl, census: Census, vehicle: Vehicle, seen: Seen) -> Finding | None:
    heard_s = census.vehicle_heard_s
    if heard_s is None or not seen.now_s - heard_s <= QUIET_S:
        number = vehicle.system_id
        return Finding(
            text=f"{url.text}: no heartbeat of system {number} any more: is it on, and is the "
            "cable or the radio still connected?",
            short=f"no heartbeat of system {number}",
        )
    if seen.asked_s is not None and seen.asked_s >= QUIET_S:
        return Finding(
            text=f"{url.text}: the autopilot is heard but answers nothing: our bytes do not reach "
            "it; check the wire from our TX to its RX, or the router's way back",
            short="autopilot heard but answers nothing",
        )
    return None


def _nothing_usable(url: LinkUrl, seen: Seen) -> Finding | None:
    if seen.byte_count == 0:
        return Finding(text=_silence(url), short="link is silent")
    if seen.refused_count == 0:
        return _no_frames(url, seen.byte_count)
    return Finding(
        text=f"{url.text}: {seen.refused_count} frames arrive, none signed with our key: give the "
        "autopilot and the companion the same one (link.signing_key_file)",
        short="frames are not signed with our key",
    )


def _silence(url: LinkUrl) -> str:
    advice = {
        "udpin": f"let the autopilot or its router send to port {url.number} of this computer",
        "udpout": f"is anything listening at {url.place} port {url.number}, and does it answer?",
        "tcp": "the other end accepted and says nothing: is it MAVLink that listens there?",
        "serial": "check that TX goes to RX and ground to ground, that the autopilot is on and "
        "that its port speaks MAVLink 2 (ArduPilot SERIALn_PROTOCOL = 2, PX4 MAV_n_CONFIG)",
    }[url.kind]
    return f"{url.text}: nothing arrives; {advice}"


def _no_frames(url: LinkUrl, count: int) -> Finding | None:
    if url.kind == "serial":
        if count < _NOISE_BYTES:
            return Finding(text=_silence(url), short="link is silent")
        return Finding(
            text=f"{url.text}: {count} bytes arrive but no MAVLink: most likely the autopilot has "
            f"another baud rate than {url.number}; write its own (ArduPilot SERIALn_BAUD, PX4 "
            "SER_TELn_BAUD) at the end of link.url",
            short=f"no MAVLink at {url.number} baud: wrong baud?",
        )
    return Finding(
        text=f"{url.text}: {count} bytes arrive but no MAVLink: another program talks to this "
        "port; stop it, or write another port in link.url",
        short="bytes arrive but no MAVLink",
    )


def _no_vehicle(url: LinkUrl, census: Census, now_s: float) -> Finding:
    others, wanted = census.autopilots(now_s), census.wanted_system_id
    if wanted and others:
        there = ", ".join(map(str, others[:5]))
        return Finding(
            text=f"{url.text}: no autopilot of system {wanted}, but of {there}: set "
            f"link.system_id = {others[0]}, or 0 for the only one there is",
            short=f"system {wanted} silent, {there[:12]} is there",
        )
    who = census.who(now_s)
    heard = f"heard are {who}" if who else "no heartbeat at all"
    return Finding(
        text=f"{url.text}: MAVLink arrives but no autopilot ({heard}): is the autopilot connected "
        "to this router, and do its heartbeats come through?",
        short="no autopilot is heard",
    )


class Teller:
    """Says a finding when it is new, and again every minute while it lasts.

    One that comes and goes, as with a heartbeat at the edge of a radio's reach, is said every
    ten seconds at most.
    """

    AGAIN_S = 60.0
    FLICKER_S = 10.0

    def __init__(self) -> None:
        self._said: str | None = None
        self._said_s = float("-inf")
        self._has_cleared = True

    def news(self, finding: Finding | None, now_s: float) -> Finding | None:
        """Return the finding if it is to be said now."""
        # The counts in a text grow; what is found is named by its short form.
        if finding is None:
            self._has_cleared = True
            return None
        pause_s = self.FLICKER_S if self._has_cleared else self.AGAIN_S
        if finding.short == self._said and now_s - self._said_s < pause_s:
            return None
        self._said, self._said_s, self._has_cleared = finding.short, now_s, False
        return finding

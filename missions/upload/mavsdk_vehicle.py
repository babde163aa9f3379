"""The vehicle as MAVSDK sees it: the only place that imports MAVSDK (extra `mavsdk`)."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import aclosing, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from companion.errors import LinkError
from companion.link.transport import parse_url
from companion.wording import missing
from missions.upload.items import Firmware, WireItem
from missions.upload.transfer import NotNowError, Progress, RefusedError, Seen, What

_logger = logging.getLogger(__name__)

MISSION_TYPE: dict[What, int] = {"mission": 0, "fence": 1}
ARMED_FLAG = 128  # MAV_MODE_FLAG_SAFETY_ARMED
# An autopilot's heartbeat comes once a second.
HEARTBEAT_S = 5.0
AUTOPILOT_COMPONENT = 1
# MAV_AUTOPILOT.
FIRMWARES: dict[int, Firmware] = {3: "ardupilot", 12: "px4"}
SET_MESSAGE_INTERVAL, MISSION_CURRENT, CURRENT_EVERY_US = 511, 42, 500_000.0
# So many heartbeats without it, and it is asked for again: a battery was changed.
ASK_EVERY = 5
REQUESTS = ("MISSION_REQUEST_INT", "MISSION_REQUEST")
# Not the vehicle's will but the way there: another attempt may go through.
PASSING = {
    "TIMEOUT": "the vehicle did not answer in time",
    "BUSY": "another transfer is under way",
    "TRANSFER_CANCELLED": "the vehicle cancelled it",
    "PROTOCOL_ERROR": "an answer did not fit",
    "INVALID_SEQUENCE": "items came twice or out of order, as over two radios or routers",
    "ERROR": "the vehicle gives no reason; another ground station may be uploading",
}
REASONS = {
    "TOO_MANY_MISSION_ITEMS": "it has no room for {count} items; upload one sortie at a time",
    "UNSUPPORTED": "it rejects an item of it, or any {what} at all",
    "DENIED": "another ground station is uploading, or its configuration forbids it",
    "INVALID_ARGUMENT": "an item has a parameter that it rejects",
    "NO_SYSTEM": "it is no longer there",
    "INT_MESSAGES_NOT_SUPPORTED": "its firmware is too old for places in whole numbers",
    "MISSION_TYPE_NOT_CONSISTENT": "items are of several kinds",
    "CURRENT_INVALID": "its first item is not the one to begin with",
}


def mavsdk_url(url: str) -> str:
    """Return a link URL of ours as MAVSDK writes it.

    >>> mavsdk_url("udpin:0.0.0.0:14550"), mavsdk_url("serial:/dev/ttyAMA0:57600")
    ('udpin://0.0.0.0:14550', 'serial:///dev/ttyAMA0:57600')
    """
    parts = parse_url(url)
    scheme = "tcpout" if parts.kind == "tcp" else parts.kind
    return f"{scheme}://{parts.place}:{parts.number}"


@asynccontextmanager
async def connected(url: str, *, wait_s: float) -> AsyncIterator[MavsdkVehicle]:
    """Have the first vehicle on a link.

    Raises:
        LinkError: there is no MAVSDK, no such link, or no vehicle on it.
    """
    target = mavsdk_url(url)
    if importlib.util.find_spec("mavsdk") is None:
        raise LinkError(missing("mavsdk"))
    from mavsdk import asyncio as mavsdk
    from mavsdk.exceptions import MavsdkError
    from mavsdk.logging import log_subscribe

    log_subscribe(_log)
    kind = mavsdk.ComponentType.GROUND_STATION
    configuration = mavsdk.Configuration.create_with_component_type(kind)
    async with mavsdk.Mavsdk(configuration) as client:
        try:
            await client.add_any_connection(target)
        except MavsdkError as error:
            raise LinkError(f"--link {url}: cannot be opened: {_fix(url, str(error))}") from error
        system = await client.first_autopilot(wait_s)
        if system is None:
            raise LinkError(
                f"--link {url}: no vehicle within {wait_s:g} s; is it switched on, "
                "and does another program hold the link?"
            )
        yield MavsdkVehicle(system, await _firmware(system, url))


def _fix(url: str, text: str) -> str:
    """Return what to do about a link that MAVSDK does not open; its own text says no more.

    >>> _fix("tcp:10.0.0.9:5760", "Connection failed: CONNECTION_ERROR")
    'nobody answers there; check the address, and that the vehicle or its radio is on'
    """
    if "BIND" in text:
        return "another program holds this port; end it, or give another"
    parts = parse_url(url)
    if parts.kind != "serial":
        return "nobody answers there; check the address, and that the vehicle or its radio is on"
    if not Path(parts.place).exists():
        return "there is no such device; plug it in, and look for its name with ls /dev/tty*"
    return "end the program that holds it, or join its group (dialout)"


def _log(_level: object, text: str, _file: object, _line: int) -> bool:
    """Keep MAVSDK's own words off the terminal."""
    _logger.debug("MAVSDK: %s", text)
    return True


async def _firmware(system: Any, url: str) -> Firmware:
    """Return what the autopilot is, by its own heartbeat where MAVSDK does not know.

    MAVSDK takes it from any heartbeat of the vehicle, and the companion's names no autopilot.
    """
    found = (await system.autopilot_type()).name
    if found == "ARDUPILOT":
        return "ardupilot"
    if found == "PX4":
        return "px4"
    beat = await _own_heartbeat(system)
    told = None if beat is None else FIRMWARES.get(int(beat["autopilot"]))
    if told is None:
        text = f"--link {url}: the vehicle is neither ArduPilot nor PX4 but {found.lower()}"
        raise LinkError(text)
    return told


async def _own_heartbeat(system: Any) -> dict[str, Any] | None:
    """Return the fields of the autopilot's next heartbeat; None where none comes."""
    from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync

    with suppress(TimeoutError):
        async with (
            asyncio.timeout(HEARTBEAT_S),
            aclosing(MavlinkDirectAsync(system).subscribe_message("HEARTBEAT")) as beats,
        ):
            async for beat in beats:
                if beat.component_id == AUTOPILOT_COMPONENT:
                    fields: dict[str, Any] = json.loads(beat.fields_json)
                    return fields
    return None


class MavsdkVehicle:
    """A `Vehicle` behind MAVSDK."""

    def __init__(self, system: Any, firmware: Firmware) -> None:
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
        from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

        self.firmware: Firmware = firmware
        self._raw = MissionRawAsync(system)
        self._direct = MavlinkDirectAsync(system)

    async def is_armed(self) -> bool | None:
        """Return what the next heartbeat of the autopilot says; None where none comes."""
        try:
            async with (
                asyncio.timeout(HEARTBEAT_S),
                aclosing(self._direct.subscribe_message("HEARTBEAT")) as beats,
            ):
                async for beat in beats:
                    if beat.component_id == AUTOPILOT_COMPONENT:
                        return bool(int(json.loads(beat.fields_json)["base_mode"]) & ARMED_FLAG)
        except TimeoutError:
            pass
        return None

    async def watch(self) -> AsyncGenerator[Seen, None]:
        """Yield what each heartbeat of the autopilot tells, with the newest item of its mission.

        ArduPilot streams it where it is asked to; PX4, which refuses that, tells every change.
        """
        heard: list[int] = []

        async def listen() -> None:
            async with aclosing(self._direct.subscribe_message("MISSION_CURRENT")) as messages:
                async for message in messages:
                    heard.append(int(json.loads(message.fields_json)["seq"]))

        listener = asyncio.create_task(listen())
        newest, silent = None, ASK_EVERY
        try:
            async with aclosing(self._direct.subscribe_message("HEARTBEAT")) as beats:
                async for beat in beats:
                    if beat.component_id != AUTOPILOT_COMPONENT:
                        continue
                    silent = 0 if heard else silent + 1
                    if silent >= ASK_EVERY and self.firmware == "ardupilot":
                        await self._ask_for_current(beat.system_id)
                        silent = 0
                    newest = heard[-1] if heard else newest
                    heard.clear()
                    armed = bool(int(json.loads(beat.fields_json)["base_mode"]) & ARMED_FLAG)
                    yield Seen(is_armed=armed, sequence=newest)
        finally:
            listener.cancel()
            await asyncio.gather(listener, return_exceptions=True)

    async def _ask_for_current(self, system_id: int) -> None:
        """Ask for a stream of MISSION_CURRENT, twice a second."""
        from mavsdk.plugins.mavlink_direct import MavlinkMessage

        numbers = {f"param{number}": 0.0 for number in range(3, 8)}
        fields = numbers | {
            "target_system": system_id,
            "target_component": AUTOPILOT_COMPONENT,
            "command": SET_MESSAGE_INTERVAL,
            "confirmation": 0,
            "param1": float(MISSION_CURRENT),
            "param2": CURRENT_EVERY_US,
        }
        await self._direct.send_message(
            MavlinkMessage("COMMAND_LONG", 0, 0, system_id, AUTOPILOT_COMPONENT, json.dumps(fields))
        )

    async def send(self, what: What, items: Sequence[WireItem], progress: Progress) -> None:
        """Upload all items."""
        from mavsdk.plugins.mission_raw import MissionPlan, MissionRawError

        raw = [_raw(number, item, what) for number, item in enumerate(items)]
        asked: list[int] = []
        try:
            if what == "fence":
                await self._raw.upload_geofence(raw)
                progress(what, 1.0)
                return
            uploading = self._raw.upload_mission_with_progress(MissionPlan(raw))
            async with self._requests(asked), aclosing(uploading) as steps:
                async for result, data in steps:
                    progress(what, 1.0 if result.name == "SUCCESS" else float(data.progress))
        except MissionRawError as error:
            last = asked[-1] if asked else None
            raise _reason(error.result.name, what, len(items), asked=last) from error

    @asynccontextmanager
    async def _requests(self, asked: list[int]) -> AsyncIterator[None]:
        """Collect the numbers of the items that the vehicle asks for: MAVSDK does not tell."""

        async def listen(name: str) -> None:
            async with aclosing(self._direct.subscribe_message(name)) as messages:
                async for message in messages:
                    asked.append(int(json.loads(message.fields_json)["seq"]))

        listeners = [asyncio.create_task(listen(name)) for name in REQUESTS]
        await asyncio.sleep(0)  # they subscribe
        try:
            yield
        finally:
            await asyncio.sleep(0)  # the last request is in its queue
            for listener in listeners:
                listener.cancel()
            await asyncio.gather(*listeners, return_exceptions=True)

    async def read(self, what: What) -> tuple[WireItem, ...]:
        """Read back what is there."""
        from mavsdk.plugins.mission_raw import MissionRawError

        try:
            if what == "fence":
                found = await self._raw.download_geofence()
            else:
                found = await self._raw.download_mission()
        except MissionRawError as error:
            if error.result.name == "NO_MISSION_AVAILABLE":
                return ()
            raise NotNowError(f"it could not be read back: {_words(error)}") from error
        return tuple(_item(each) for each in found)

    async def begin(self) -> None:
        """Make the mission's first item the one to fly to; MAVSDK waits until it is."""
        from mavsdk.plugins.mission_raw import MissionRawError

        try:
            await self._raw.set_current_mission_item(0)
        except MissionRawError as error:
            raise NotNowError(f"the first item does not count: {_words(error)}") from error


def _words(error: Any) -> str:
    """Return a result of MAVSDK in words."""
    name = error.result.name
    return PASSING.get(name) or REASONS.get(name, f"MAVSDK says {name}")


def _reason(name: str, what: What, count: int, *, asked: int | None = None) -> Exception:
    """Return the error for a result of MAVSDK."""
    if name in PASSING:
        return NotNowError(f"the transfer broke off: {PASSING[name]}")
    reason = REASONS.get(name, f"MAVSDK says {name}").format(count=count, what=what)
    more = "; --no-fence uploads the mission alone" if what == "fence" else ""
    if name == "UNSUPPORTED" and asked is not None:
        reason = "it does not take this item"
    return RefusedError(f"the vehicle refuses the {what}: {reason}{more}", asked)


def _raw(number: int, item: WireItem, what: What) -> Any:
    from mavsdk.plugins.mission_raw import MissionItem

    return MissionItem(
        seq=number,
        frame=item.frame,
        command=item.command,
        current=int(number == 0 and what == "mission"),
        autocontinue=int(item.goes_on),
        param1=item.params[0],
        param2=item.params[1],
        param3=item.params[2],
        param4=item.params[3],
        x=item.x,
        y=item.y,
        z=item.z_m,
        mission_type=MISSION_TYPE[what],
    )


def _item(raw: Any) -> WireItem:
    return WireItem(
        command=int(raw.command),
        frame=int(raw.frame),
        params=(raw.param1, raw.param2, raw.param3, raw.param4),
        x=int(raw.x),
        y=int(raw.y),
        z_m=float(raw.z),
        goes_on=bool(raw.autocontinue),
    )

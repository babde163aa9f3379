"""`vrspray top`: the live state of a companion that runs elsewhere, from its MAVLink alone.

Somebody who only listens learns a companion's values, texts and heartbeats.
"""

from __future__ import annotations

import asyncio
import errno
import sys
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import asdict
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, new_app, note
from companion.cli.drawing import drawn
from companion.cli.live import DRAWN_EVERY_S, PLAIN_EVERY_S, Shown
from companion.cli.terminal import terminal
from companion.core.types import SprayerState
from companion.errors import LinkError
from companion.link.census import AUTOPILOT_COMPONENT, mode_name
from companion.link.framer import Framer, decoded

# An error that was told is shown for so long; nobody tells that it is over.
FAULT_S = 60.0
# Reasons come in two lines at most, one right after the other.
_SAME_S = 0.5
_OFF, _SAID, _ERROR = "Spray off: ", "Spray: ", 3
_FAULTS_MAX = 4
_VALUES_MAX = 32
# A value that has not come again for so long is not known any more; they come at 0.2 Hz at least.
OLD_S = 12.0


class Overheard:
    """Takes bytes of a link, and keeps what a companion on it says of itself."""

    def __init__(self) -> None:
        self._framer = Framer()
        self._values: dict[str, tuple[float, float]] = {}
        self._why: tuple[str, float] = ("", float("-inf"))
        self._faults: deque[tuple[str, float]] = deque(maxlen=_FAULTS_MAX)
        self.companion: tuple[int, int] | None = None
        self.heard_s: float | None = None
        self.heartbeat_s: float | None = None
        self.vehicle_s: float | None = None
        self.position_s: float | None = None
        self.height_m: float | None = None
        self.speed_m_s: float | None = None
        self.mode = ""
        self.armed = False

    def take(self, data: bytes, now_s: float) -> None:
        """Take bytes in; what is no message is dropped."""
        for message in map(decoded, self._framer.push(data, now_s)):
            if message is not None:
                self._take(message, message.get_type(), now_s)

    def _take(self, message: Any, kind: str, now_s: float) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "NAMED_VALUE_FLOAT" and message.name.startswith("SPR_"):
            self.companion = self.companion or sender
        if sender == self.companion:
            self._take_companion(message, kind, now_s)
        elif sender[1] == AUTOPILOT_COMPONENT and (
            self.companion is None or sender[0] == self.companion[0]
        ):
            self._take_vehicle(message, kind, now_s)

    def _take_companion(self, message: Any, kind: str, now_s: float) -> None:
        self.heard_s = now_s
        if kind == "HEARTBEAT":
            self.heartbeat_s = now_s
        elif kind == "NAMED_VALUE_FLOAT":
            if message.name in self._values or len(self._values) < _VALUES_MAX:
                self._values[message.name] = (float(message.value), now_s)
        elif kind == "STATUSTEXT":
            self._take_text(message.text, message.severity, now_s)

    def _take_text(self, text: str, severity: int, now_s: float) -> None:
        said, said_s = self._why
        if text.startswith(_OFF):
            more = text.removeprefix(_OFF)
            self._why = (f"{said}, {more}" if now_s - said_s < _SAME_S else more, now_s)
        elif text == f"{_SAID}ready":
            self._why = ("", now_s)
        elif severity <= _ERROR:
            self._faults.append((text.removeprefix(_SAID), now_s))

    def _take_vehicle(self, message: Any, kind: str, now_s: float) -> None:
        if kind == "HEARTBEAT":
            self.vehicle_s = now_s
            self.mode = mode_name(message.autopilot, message.type, message.custom_mode)
            self.armed = bool(message.base_mode & 128)
        elif kind == "GLOBAL_POSITION_INT":
            self.position_s = now_s
            self.height_m = message.relative_alt / 1000.0
            self.speed_m_s = float((message.vx**2 + message.vy**2) ** 0.5 / 100.0)

    def value(self, name: str, now_s: float, *, old_s: float = OLD_S) -> float | None:
        """Return a value by its name on the wire; None where it has not been told of late."""
        value, told_s = self._values.get(name, (0.0, float("-inf")))
        return value if now_s - told_s <= old_s else None

    def state(self, now_s: float) -> SprayerState | None:
        """Return what the sprayer may do, as it says itself."""
        number, states = self.value("SPR_STATE", now_s), list(SprayerState)
        if number is None or not 0 <= number < len(states):
            return None
        return states[int(number)]

    @property
    def why(self) -> str:
        """Return why nothing was sprayed when that was told last."""
        return self._why[0]

    def faults(self, now_s: float) -> list[str]:
        """Return the errors that were told within the last minute."""
        return list(
            dict.fromkeys(text for text, told_s in self._faults if now_s - told_s <= FAULT_S)
        )


# Who only listens is none of the vehicle's system, and no ground station: ArduPilot's failsafe
# waits for the heartbeats of a station and must not take ours for one.
_SYSTEM, _COMPONENT = 254, 191
_BEAT_S = 1.0
_TAKEN = (
    "another program listens there, and if it is `vrspray run`, both cannot; let the router or the "
    "autopilot send to a second port as well (mavproxy.py --out udp:127.0.0.1:14551) and give "
    "that one: udpin:127.0.0.1:14551"
)
_TRAINING = {1.0: "water", 2.0: "dry", 3.0: "ground"}

app = new_app()


@app.command(epilog="Example: vrspray top --link udpin:127.0.0.1:14551")
def top(
    link: Annotated[
        str,
        typer.Option(metavar="URL", help="udpin:, udpout:, tcp:HOST:PORT or serial:DEVICE:BAUD."),
    ],
    duration_s: Annotated[
        float | None, typer.Option(min=0.0, max=1e7, help="Stop after this time.")
    ] = None,
    wait_s: Annotated[
        float, typer.Option(min=0.0, max=600.0, help="With --json: longest time to wait for it.")
    ] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Show the live state of a running companion, from its MAVLink alone. Ctrl-C ends it.

    Commands nothing. Exit 0: a companion was heard; 1: none was.
    """
    heard = Overheard()
    with suppress(KeyboardInterrupt):
        if as_json:
            asyncio.run(_until_known(heard, link, wait_s))
        else:
            asyncio.run(_show(heard, link, duration_s))
    is_heard = heard.companion is not None
    if as_json:
        shown = asdict(shown_of(heard, time.monotonic()))
        answer({"ok": is_heard, "link": link, **shown}, (), as_json=True)
    if not is_heard:
        note(f"no companion was heard on {link}; is vrspray run active, and does it reach here?")
    raise typer.Exit(0 if is_heard else 1)


def shown_of(heard: Overheard, now_s: float) -> Shown:
    """Return what is shown of what was heard."""

    def value(name: str) -> float | None:
        return heard.value(name, now_s)

    def age(at_s: float | None) -> float | None:
        return None if at_s is None else now_s - at_s

    state = heard.state(now_s)
    holds = state in (SprayerState.SPRAYING, None)
    vehicle = [heard.mode, "armed" if heard.armed else "disarmed"] if heard.mode else []
    if heard.height_m is not None:
        vehicle.append(f"{heard.height_m:.1f} m")
    return Shown(
        state="no companion heard" if state is None else state.value,
        why="" if holds else heard.why,
        wanted_l_ha=value("SPR_RATE"),
        given_l_ha=value("SPR_GIVEN") if state is SprayerState.SPRAYING else None,
        percent=value("SPR_PCT") or 100.0,
        flow_l_min=value("SPR_FLOW"),
        volume_l=value("SPR_LITRE"),
        tank_l=value("SPR_TANK"),
        next_s=heard.value("SPR_NEXT", now_s, old_s=DRAWN_EVERY_S),
        speed_m_s=heard.speed_m_s,
        vehicle=", ".join(vehicle),
        ages_s={
            "companion": age(heard.heartbeat_s),
            "vehicle": age(heard.vehicle_s),
            "position": age(heard.position_s),
        },
        faults=heard.faults(now_s),
        training=_TRAINING.get(value("SPR_TRAIN") or 0.0, ""),
    )


async def _turns(heard: Overheard, link: str) -> AsyncIterator[float]:
    """Listen, and yield the time again and again."""
    from companion.link.encode import STATE_ACTIVE, Encoder
    from companion.link.vehicle_link import open_transport

    encoder = Encoder(system_id=_SYSTEM, component_id=_COMPONENT)
    try:
        transport = await open_transport(
            link,
            lambda data: heard.take(data, time.monotonic()),
            lambda is_up: note(f"link {'up' if is_up else 'lost'}: {link}"),
            lambda text: note(f"waiting: {text}"),
        )
    except LinkError as error:
        what = str(error).replace("link.url = ", "--link ")
        if not isinstance(error.__cause__, OSError) or error.__cause__.errno != errno.EADDRINUSE:
            raise LinkError(what) from error
        raise LinkError(f"--link {link!r}: {_TAKEN}") from error
    beat_s = float("-inf")
    try:
        while True:
            now_s = time.monotonic()
            # Who waits for others need not speak; a router learns of the others by their beats.
            if now_s - beat_s >= _BEAT_S and not link.startswith("udpin:"):
                beat_s = now_s
                transport.send(encoder.heartbeat(STATE_ACTIVE))
            yield now_s
            await asyncio.sleep(DRAWN_EVERY_S)
    finally:
        await transport.close()


async def _until_known(heard: Overheard, link: str, wait_s: float) -> None:
    """Listen until the state and what belongs to it is there."""
    began_s = time.monotonic()
    async for now_s in _turns(heard, link):
        is_known = heard.state(now_s) is not None and None not in (
            heard.heartbeat_s,
            heard.value("SPR_LITRE", now_s),
        )
        if is_known or now_s - began_s >= wait_s:
            return


async def _show(heard: Overheard, link: str, duration_s: float | None) -> None:
    began_s = time.monotonic()
    show: Any = _Block() if sys.stdout.isatty() else _Lines()
    with show:
        async for now_s in _turns(heard, link):
            silent_s = 0.0 if heard.heard_s is None else now_s - heard.heard_s
            show.take(shown_of(heard, now_s), now_s, silent_s)
            if duration_s is not None and now_s - began_s >= duration_s:
                return


class _Block:
    """One block on the terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(
            drawn(Shown(state="no companion heard")),
            console=Console(file=terminal(sys.stdout)),
            auto_refresh=False,
        )

    def __enter__(self) -> None:
        self._live.__enter__()

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def take(self, shown: Shown, _now_s: float, silent_s: float) -> None:
        self._live.update(drawn(shown, silent_s=silent_s), refresh=True)


class _Lines:
    """A line a change, and one now and then while it sprays."""

    def __init__(self) -> None:
        self._told: object = None
        self._told_s = float("-inf")

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def take(self, shown: Shown, now_s: float, _silent_s: float) -> None:
        told = (shown.state, shown.why, tuple(shown.faults))
        if told == self._told and (
            shown.state != "spraying" or now_s - self._told_s < PLAIN_EVERY_S
        ):
            return
        self._told, self._told_s = told, now_s
        typer.echo(shown.line())

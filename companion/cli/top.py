"""`vrspray top`: the live state of a companion that runs elsewhere, from its MAVLink alone."""

from __future__ import annotations

import asyncio
import errno
import sys
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, note
from companion.cli.live import DRAWN_EVERY_S, PLAIN_EVERY_S, Shown, drawn
from companion.core.types import SprayerState
from companion.errors import LinkError

if TYPE_CHECKING:
    from companion.link.overhear import Overheard

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

app = typer.Typer(add_completion=False, rich_markup_mode=None)


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
    from companion.link.overhear import Overheard

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
        from rich.live import Live

        self._live = Live(drawn(Shown(state="no companion heard")), auto_refresh=False)

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

"""The page's own web server: state by server-sent events, orders by POST, nothing else.

It runs in a process of its own and holds no valve: it reads shared memory, and passes orders on to
the control loop, which decides. Every request passes `Guarded` first.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import os
import secrets
import socket
import time
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, FastAPI, HTTPException, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.types import Receive, Send
from starlette.types import Scope as Connection

from companion.web.entrance import REFUSED, Body, add_sessions, unusable
from companion.web.guard import API, Guard
from companion.web.live import Live, map_parts
from companion.web.parts import Host, Part, Work

STATIC = Path(__file__).parent / "static"
STATE_S = 0.2  # 5 Hz
SILENT_S = 1.0  # with nothing new a browser is told so, and how old the newest is
POINTS_AT_ONCE = 500
CLIENTS_MAX = 32
# Pressing Enable takes this long; a press that is older has been forgotten.
HOLD_S, HOLD_MAX_S = 0.9, 6.0
HOLDS_MAX = 64
ANSWER_WITHIN_S = 1.0
CHECKS_S, CHECKS_WITHIN_S = 60.0, 60.0
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


class Press(Body):
    """The ticket that `hold` gave when the press began."""

    ticket: Annotated[str, Field(min_length=1, max_length=100)]


class Refilled(Body):
    """What is in the tank now, in litres; 0 is a full tank."""

    litres: Annotated[float, Field(ge=0.0, le=10_000.0)]


class Declared(Body):
    """What the operator observed on the ground, and when; the limits file says what it must be."""

    observed_at: Annotated[str, Field(min_length=16, max_length=30)]
    wind_m_s: Annotated[float, Field(ge=0.0, le=60.0)] | None = None
    wind_from_deg: Annotated[float, Field(ge=0.0, le=360.0)] | None = None
    temperature_c: Annotated[float, Field(ge=-40.0, le=60.0)] | None = None
    humidity_percent: Annotated[float, Field(ge=0.0, le=100.0)] | None = None
    inversion: Literal["no", "yes"] | None = None
    droplet_class: Annotated[str, Field(min_length=1, max_length=40)] | None = None

    def said(self) -> dict[str, str | float]:
        """Return what was declared, by the configuration's dotted keys."""
        given = self.model_dump(exclude_none=True)
        tables = {"droplet_class": "product"}
        return {f"{tables.get(key, 'application')}.{key}": value for key, value in given.items()}


class Done(BaseModel):
    """What came of an order, in words for the operator."""

    accepted: bool
    text: str


class Ticket(BaseModel):
    """To give back when the button has been held for `hold_s` seconds."""

    ticket: str
    hold_s: float


class Orders:
    """Passes orders to the control loop and waits for what it says of them."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._connection = connection
        self._count = 0
        self._waiting: dict[int, asyncio.Future[Done]] = {}
        # A STOP that is on its way, with no other order behind it.
        self._stopping: asyncio.Future[Done] | None = None

    def attach(self, on_end: Callable[[], None]) -> None:
        """Begin to read answers; `on_end` is called when the companion has ended."""
        asyncio.get_running_loop().add_reader(self._connection, self._read, on_end)

    async def give(
        self, name: str, value: float | None = None, said: Mapping[str, object] | None = None
    ) -> Done:
        """Pass an order on; a 503 where the companion does not answer.

        A STOP that is on its way is everybody's who stops meanwhile: a flood of them is one at a
        time, and keeps no other order from the loop.
        """
        self._count += 1
        number = self._count
        boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        order = {"number": number, "name": name, "value": value, "boot_s": boot_s, "said": said}
        joined = self._stopping if name == "stop" else None
        waiting = joined or asyncio.get_running_loop().create_future()
        self._waiting[number] = waiting
        self._stopping = waiting if name == "stop" else None
        try:
            if joined is None:
                self._connection.send(json.dumps(order).encode())
            return await asyncio.wait_for(asyncio.shield(waiting), ANSWER_WITHIN_S)
        except (OSError, TimeoutError) as error:
            text = "the companion does not answer: use the transmitter's switch"
            raise HTTPException(503, text) from error
        finally:
            del self._waiting[number]
            if self._stopping is waiting:
                self._stopping = None

    def _read(self, on_end: Callable[[], None]) -> None:
        packet = b""
        with suppress(ConnectionError):
            try:
                packet = self._connection.recv(4096)
            except BlockingIOError:
                return
        if not packet:
            asyncio.get_running_loop().remove_reader(self._connection)
            on_end()
            return
        answer = json.loads(packet)
        waiting = self._waiting.get(answer["number"])
        if waiting is not None and not waiting.done():
            waiting.set_result(Done(accepted=answer["accepted"], text=answer["text"]))


class Holds:
    """Buttons that are being pressed: enabling takes a ticket that was given a second before."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since: dict[str, float] = {}

    def begin(self) -> str:
        """Return a ticket for a press that begins now."""
        while len(self._since) >= HOLDS_MAX:
            self._since.pop(next(iter(self._since)))
        ticket = secrets.token_urlsafe(16)
        self._since[ticket] = self._clock()
        return ticket

    def take(self, ticket: str) -> bool:
        """Return whether the press lasted long enough and is not over; a ticket is good once."""
        since_s = self._since.pop(ticket, None)
        return since_s is not None and HOLD_S <= self._clock() - since_s <= HOLD_MAX_S

    def clear(self) -> None:
        """Forget all presses: after a stop none of them enables."""
        self._since.clear()


class EventStream(Response):
    """The state for one browser: at most 5 Hz, a change at once, never a backlog."""

    media_type = "text/event-stream"

    def __init__(self, site: Site, since: int) -> None:
        super().__init__(headers={"X-Accel-Buffering": "no"})
        self._site, self._since = site, since

    async def __call__(self, scope: Connection, receive: Receive, send: Send) -> None:  # noqa: ARG002
        """Send until the browser goes."""
        headers = [item for item in self.raw_headers if item[0] != b"content-length"]
        start = {"type": "http.response.start", "status": 200, "headers": headers}
        self._site.clients += 1
        gone = asyncio.ensure_future(_gone(receive))
        try:
            await send(start)
            async for data in self._site.events(self._since, gone):
                await send({"type": "http.response.body", "body": data, "more_body": True})
        finally:
            self._site.clients -= 1
            gone.cancel()


async def _gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


class Site:
    """What all requests share: the newest state, the way to the control loop, who may what."""

    def __init__(self, live: Live, orders: Orders, guard: Guard, about: dict[str, Any]) -> None:
        self.live, self.orders, self.guard = live, orders, guard
        self.holds = Holds()
        self.clients = 0
        self.login_s = int(about["login_s"])
        self.is_tls = bool(about["is_tls"])
        ground, zones, places = map_parts(about["map"])
        self.ground_gzip, self.zones_gzip = _packed(ground), _packed(zones)
        self.places_gzip = [_packed(part) for part in places]
        self.facts: dict[str, Any] = about["facts"]
        self.version = str(about["version"])
        self._files: dict[Path, tuple[bytes, str]] = {}
        self._news = asyncio.Event()
        self.host: dict[str, Any] = {**about["host"], "work": Work()}
        self._doctor: list[str] = about["doctor"]
        self._checks: list[dict[str, Any]] = []
        self._checked_s = float("-inf")
        self._checked_with: dict[str, Any] = {}
        self._checking = asyncio.Lock()

    async def checks(self) -> list[dict[str, Any]]:
        """Return what `vrspray doctor --no-link` finds; while the vehicle is armed nothing new.

        It computes for a second or two: once in `CHECKS_S` at most, at the lowest priority.
        """
        is_armed = (self.live.state.get("vehicle") or {}).get("armed") is not False
        async with self._checking:
            said = (self.live.state.get("declared") or {}).get("said") or {}
            is_old = time.monotonic() - self._checked_s > CHECKS_S or said != self._checked_with
            if is_old and self._doctor and not is_armed:
                words = [word for item in said.items() for word in ("--set", "{}={}".format(*item))]
                self._checks = await _output_of([*self._doctor, *words])
                self._checked_s, self._checked_with = time.monotonic(), said
        return self._checks

    def told(self) -> None:
        """Take that there is a newer state."""
        news, self._news = self._news, asyncio.Event()
        news.set()

    def snapshot(self) -> dict[str, Any]:
        """Return the newest state with its age; without any, only that there is none."""
        state = self.live.state
        if not state:
            return {"age_s": None}
        return {**state, "age_s": round(time.monotonic() - state["now_s"], 2)}

    async def events(self, since: int, gone: asyncio.Future[None]) -> Any:
        """Yield events: the state, and the points of the way that this browser has not had."""
        sent_version, sent_s = -1, float("-inf")
        while not gone.done():
            live, now_s = self.live, time.monotonic()
            is_urgent = live.urgent > sent_version
            wait_s = 0.0 if is_urgent else sent_s + STATE_S - now_s
            if wait_s > 0.0 or live.version == sent_version:
                news = self._news
                left_s = SILENT_S - (now_s - sent_s)
                limit_s = wait_s if live.version != sent_version else max(left_s, 0.0)
                if limit_s > 0.0:
                    with suppress(TimeoutError):
                        await asyncio.wait_for(_either(news, gone), limit_s)
                    continue
            points = live.way.points
            if since > len(points):
                since = 0
            until = min(len(points), since + POINTS_AT_ONCE)
            event = {"state": self.snapshot(), "since": since, "points": points[since:until]}
            event["way"] = live.way_id
            since, sent_version, sent_s = until, live.version, now_s
            yield f"id: {since}\ndata: {json.dumps(event, separators=(',', ':'))}\n\n".encode()

    def file(self, folder: Path, name: str) -> tuple[bytes, str]:
        """Return a file of the page, compressed, and its type; read once and kept."""
        path = (folder / name.replace("\0", "/")).resolve()
        if path not in self._files:
            kind = _TYPES.get(path.suffix)
            if kind is None or not path.is_relative_to(folder.resolve()) or not path.is_file():
                raise HTTPException(404, "not found")
            self._files[path] = (gzip.compress(path.read_bytes(), 6), kind)
        return self._files[path]

    def page_of(self, name: str, part: Part) -> tuple[bytes, str]:
        """Return the page of a part: what it has of its own, within what all parts have alike."""
        path = part.static / "main.html"
        if path not in self._files:
            if not path.is_file():
                raise HTTPException(404, "not found")
            words = {"name": name, "title": part.title, "TITLE": part.title.upper()}
            text = (STATIC / "part.html").read_text(encoding="utf-8")
            for word, value in words.items():
                text = text.replace(f"{{{word}}}", escape(value))
            text = text.replace("{main}", path.read_text(encoding="utf-8"))
            self._files[path] = (gzip.compress(text.encode(), 6), _TYPES[".html"])
        return self._files[path]

    def flying(self) -> str | None:
        """Return why nothing may be worked out beside the flight now; None on the ground."""
        vehicle = self.live.state.get("vehicle") or {}
        if vehicle.get("in_air"):
            return "the vehicle is in the air: wait until it has landed and is disarmed"
        return "the vehicle is armed: disarm it first" if vehicle.get("armed") else None


def _packed(item: object) -> bytes:
    return gzip.compress(json.dumps(item, separators=(",", ":"), allow_nan=False).encode(), 5)


async def _output_of(command: list[str]) -> list[dict[str, Any]]:
    """Return the checks that a doctor prints; none where it does not answer."""
    try:
        child = await asyncio.create_subprocess_exec(
            *command, stdin=DEVNULL, stdout=PIPE, stderr=DEVNULL, preexec_fn=lambda: os.nice(19)
        )
    except OSError:
        return []
    try:
        out, _ = await asyncio.wait_for(child.communicate(), CHECKS_WITHIN_S)
        found: list[dict[str, Any]] = json.loads(out)["checks"]
    except (TimeoutError, ValueError, KeyError):
        with suppress(ProcessLookupError):
            child.kill()
        await child.wait()
        return []
    return found


async def _either(news: asyncio.Event, gone: asyncio.Future[None]) -> None:
    """Wait for news, or for the browser to go."""
    waiting = asyncio.ensure_future(news.wait())
    try:
        await asyncio.wait((waiting, gone), return_when=asyncio.FIRST_COMPLETED)
    finally:
        waiting.cancel()


def _compressed(request: Request, data: bytes, kind: str) -> Response:
    """Return what is kept compressed; plain for who cannot read that."""
    headers = {"Vary": "Accept-Encoding", "Cache-Control": "no-cache"}
    if "gzip" not in request.headers.get("accept-encoding", ""):
        return Response(gzip.decompress(data), media_type=kind, headers=headers)
    return Response(data, media_type=kind, headers=headers | {"Content-Encoding": "gzip"})


def build_app(site: Site, parts: Mapping[str, Part] | None = None) -> FastAPI:
    """Return the application with its further parts; `Guarded` belongs around it."""
    app = FastAPI(
        title="vrspray operator's page",
        version=site.version,
        summary="The state of a running companion, and the operator's orders.",
        docs_url=None,
        redoc_url=None,
        openapi_url=f"{API}openapi.json",
    )
    app.add_exception_handler(RequestValidationError, unusable)
    _add_reading(app, site)
    _add_ground(app, site)
    add_sessions(app, site.guard, login_s=site.login_s, is_tls=site.is_tls)
    _add_orders(app, site)
    _add_files(app, site)
    for name, part in (parts or {}).items():
        _add_part(app, site, name, part)
    return app


def _add_reading(app: FastAPI, site: Site) -> None:
    @app.get(f"{API}state", tags=["state"])
    async def state() -> dict[str, Any]:
        """Return the newest state."""
        return site.snapshot()

    @app.get(f"{API}events", tags=["state"], response_class=Response)
    async def events(
        request: Request, since: Annotated[int, Query(ge=0, le=10**9)] = 0
    ) -> Response:
        """Stream the state at 5 Hz and each change at once, as server-sent events."""
        if site.clients >= CLIENTS_MAX:
            raise HTTPException(503, f"{CLIENTS_MAX} browsers are looking already")
        last = request.headers.get("last-event-id", "")
        begin = int(last) if last.isascii() and last.isdecimal() and len(last) < 10 else since
        return EventStream(site, begin)

    @app.get(f"{API}facts", tags=["state"])
    async def facts() -> dict[str, Any]:
        """Return what does not change in a flight: limits, product, tank, training."""
        return site.facts

    @app.get(f"{API}checks", tags=["state"])
    async def checks() -> dict[str, Any]:
        """Return what the doctor finds on this computer; run while the vehicle is disarmed."""
        return {"checks": await site.checks()}

    @app.get(f"{API}track", tags=["state"])
    async def track(since: Annotated[int, Query(ge=0, le=10**9)] = 0) -> dict[str, Any]:
        """Return the points of the way since a number."""
        points = site.live.way.points
        return {"since": since, "count": len(points), "points": points[since : since + 20_000]}


def _add_ground(app: FastAPI, site: Site) -> None:
    @app.get(f"{API}map", tags=["state"], response_class=Response)
    async def ground(request: Request) -> Response:
        """Return field, rates and boom, in metres from the origin."""
        return _compressed(request, site.ground_gzip, "application/json")

    @app.get(f"{API}zones", tags=["state"], response_class=Response)
    async def zones(request: Request) -> Response:
        """Return the zones, in metres from the origin."""
        return _compressed(request, site.zones_gzip, "application/json")

    @app.get(f"{API}zones.geojson", tags=["state"], response_class=Response)
    async def places(request: Request, part: Annotated[int, Query(ge=0, le=10**6)] = 0) -> Response:
        """Return a part of the zones as GeoJSON: a browser's worker reads it."""
        if part >= len(site.places_gzip):
            raise HTTPException(404, f"there are {len(site.places_gzip)} parts")
        return _compressed(request, site.places_gzip[part], "application/geo+json")


def _add_orders(app: FastAPI, site: Site) -> None:
    @app.post(f"{API}stop", tags=["orders"], responses=REFUSED)
    async def stop() -> Done:
        """Close all valves and latch; no session is needed."""
        site.holds.clear()
        return await site.orders.give("stop")

    @app.post(f"{API}hold", tags=["orders"], responses=REFUSED)
    async def hold() -> Ticket:
        """Begin to press a button that has to be held."""
        return Ticket(ticket=site.holds.begin(), hold_s=HOLD_S)

    @app.post(f"{API}enable", tags=["orders"], responses=REFUSED)
    async def enable(press: Press) -> Done:
        """Allow spraying, after the button was held."""
        if not site.holds.take(press.ticket):
            return Done(accepted=False, text=f"hold the button for {HOLD_S:g} s")
        return await site.orders.give("enable")

    @app.post(f"{API}disable", tags=["orders"], responses=REFUSED)
    async def disable() -> Done:
        """Close all valves; also releases a stop that was commanded."""
        site.holds.clear()
        return await site.orders.give("disable")

    @app.post(f"{API}refilled", tags=["orders"], responses=REFUSED)
    async def refilled(filling: Refilled) -> Done:
        """Take what is in the tank now."""
        return await site.orders.give("refilled", filling.litres)

    @app.post(f"{API}declare", tags=["orders"], responses=REFUSED)
    async def declare(declared: Declared) -> Done:
        """Take the weather that the operator observed; while the vehicle is disarmed."""
        return await site.orders.give("declare", said=declared.said())


def _add_files(app: FastAPI, site: Site) -> None:
    @app.get("/register_service", tags=["integration"])
    async def register_service() -> dict[str, Any]:
        """Tell BlueOS who we are."""
        return {
            "name": "Variable-rate spraying",
            "description": "State of the sprayer, stop and enable",
            "icon": "mdi-spray",
            "company": "vrspray",
            "version": site.version,
            "webpage": "",
            "api": f"{API}openapi.json",
            "new_page": False,
            "works_in_relative_paths": True,
        }

    @app.get("/", include_in_schema=False)
    async def index(request: Request) -> Response:
        return _compressed(request, *site.file(STATIC, "index.html"))

    @app.get("/static/{name:path}", include_in_schema=False)
    async def static(name: str, request: Request) -> Response:
        return _compressed(request, *site.file(STATIC, name))


def _add_part(app: FastAPI, site: Site, name: str, part: Part) -> None:
    """Add what another package registered: its files at NAME/, its interface at api/v1/NAME/."""
    router = APIRouter(prefix=f"{API}{name}", tags=[name], responses=REFUSED)

    def choose(field: str) -> Coroutine[Any, Any, Done]:
        return site.orders.give("field", said={"field": field})

    part.add(router, Host(flying=site.flying, choose=choose, **site.host))
    app.include_router(router)
    site.facts.setdefault("parts", []).append({"name": name, "title": part.title})

    @app.get(f"/{name}/{{file:path}}", include_in_schema=False)
    async def file(file: str, request: Request) -> Response:
        found = site.file(part.static, file) if file else site.page_of(name, part)
        return _compressed(request, *found)

"""The fleet's page on a port of its own: read only, behind the guard of the operator's page."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Response
from fastapi.exceptions import RequestValidationError

from analysis.fleet.asking import asked
from analysis.fleet.page import body_of, files_of, stylesheet
from analysis.fleet.store import Store
from analysis.fleet.summary import Chosen, summary_of
from companion.errors import VrsprayError
from companion.web.entrance import REFUSED, Guarded, add_sessions, server_of, unusable
from companion.web.guard import API, Guard
from companion.web.places import Places

LOGIN_S = 12 * 3600
# The same question within so long has the same answer: a summary takes a second of computing.
KEPT_S, KEPT_MAX = 10.0, 8
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".csv": "text/csv; charset=utf-8",
    ".json": "application/json",
    ".parquet": "application/vnd.apache.parquet",
}
_LISTED = ("fleet.json", "by-machine.csv", "by-field.csv", "by-month.csv")

Since = Annotated[str | None, Query(alias="from", max_length=7)]
Until = Annotated[str | None, Query(max_length=7)]
Kind = Annotated[list[str] | None, Query(max_length=4)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What one question was answered: the page's body, and the files."""

    at_s: float
    html: str
    files: dict[str, bytes]


class Readings:
    """Answers questions one after the other, and the same one from memory."""

    def __init__(self, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        self._store, self._clock = store, clock
        self._lock = asyncio.Lock()
        self._kept: dict[Chosen, Reading] = {}

    async def of(self, chosen: Chosen) -> Reading:
        """Return the answer; an HTTPException says in a line why there is none."""
        async with self._lock:
            kept = self._kept.get(chosen)
            if kept is None or self._clock() - kept.at_s > KEPT_S:
                while len(self._kept) >= KEPT_MAX:
                    self._kept.pop(next(iter(self._kept)))
                try:
                    kept = await asyncio.to_thread(self._read, chosen)
                except VrsprayError as error:
                    raise HTTPException(422, " ".join(str(error).split())[:300]) from error
                self._kept[chosen] = kept
            return kept

    def _read(self, chosen: Chosen) -> Reading:
        at_s = self._clock()
        with asked(self._store.existing()) as fleet:
            summary = summary_of(fleet, chosen)
        return Reading(at_s=at_s, html=body_of(summary), files=files_of(summary))


def build_app(store: Store, guard: Guard, places: Places, *, is_tls: bool = False) -> Guarded:
    """Return the application; nothing in it changes anything."""
    app = FastAPI(
        title="vrspray fleet",
        version=version("vrspray"),
        docs_url=None,
        redoc_url=None,
        openapi_url=f"{API}openapi.json",
    )
    app.add_exception_handler(RequestValidationError, unusable)
    add_sessions(app, guard, login_s=LOGIN_S, is_tls=is_tls)
    readings = Readings(store)

    def chosen(since: str | None, until: str | None, kinds: list[str] | None) -> Chosen:
        return Chosen(since=since, until=until, kinds=tuple(sorted(set(kinds or ()))))

    @app.get(f"{API}fleet", tags=["fleet"], responses=REFUSED)
    async def fleet(since: Since = None, until: Until = None, kind: Kind = None) -> dict[str, Any]:
        """Return the summary as the page shows it, and the names of its files."""
        reading = await readings.of(chosen(since, until, kind))
        return {"html": reading.html, "files": [each for each in _LISTED if each in reading.files]}

    @app.get(f"{API}files/{{name}}", tags=["fleet"], responses=REFUSED, response_class=Response)
    async def file(
        name: str,
        since: Since = None,
        until: Until = None,
        kind: Kind = None,
    ) -> Response:
        """Return one of the report's files."""
        content = (await readings.of(chosen(since, until, kind))).files.get(name)
        if content is None:
            raise HTTPException(404, "not found")
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(content, media_type=_TYPES[Path(name).suffix], headers=headers)

    @app.get("/", include_in_schema=False)
    async def index() -> Response:
        return _static("index.html")

    @app.get("/static/{name}", include_in_schema=False)
    async def static(name: str) -> Response:
        return _static(name)

    return Guarded(app, guard, places)


def _static(name: str) -> Response:
    if name == "page.css":
        return Response(stylesheet(), media_type=_TYPES[".css"])
    if name not in ("index.html", "fleet.js"):
        raise HTTPException(404, "not found")
    content = resources.files("analysis.fleet").joinpath("static", name).read_bytes()
    return Response(content, media_type=_TYPES[Path(name).suffix])


def serve(
    store: Store, guard: Guard, listener: socket.socket, tls: tuple[str, str] | None = None
) -> None:
    """Serve until Ctrl-C, or a signal to end."""
    places = Places()
    app = build_app(store, guard, places, is_tls=tls is not None)
    server = server_of(app, tls=tls, shutdown_within_s=2)
    with suppress(KeyboardInterrupt):
        server.run(sockets=[places.listening(listener)])

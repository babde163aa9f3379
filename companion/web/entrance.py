"""The entrance of a page: every request passes `Guarded`, and a token opens a session.

The operator's page and the fleet's have it in common.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as Connection

from companion.web.guard import API, COOKIE, Asked, Guard, Scope, session, since_start_s
from companion.web.places import AT_ONCE, WAIT_S, Places

BODY_BYTES_MAX = 4096
BODY_WITHIN_S, SEND_WITHIN_S = 10.0, 20.0
_CSP = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors "
)
REFUSED: dict[int | str, dict[str, Any]] = {
    401: {"description": "no session"},
    403: {"description": "not from the page, or the session may only look"},
    408: {"description": "too slow"},
    413: {"description": "too large"},
    415: {"description": "no JSON"},
    503: {"description": "the companion does not answer"},
}


class Body(BaseModel):
    """A request's own small JSON: nothing unknown is in it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Login(Body):
    """The token of the link or QR code that `vrspray token show` prints."""

    token: Annotated[str, Field(min_length=1, max_length=200)]


class Access(BaseModel):
    """What one may do here."""

    scope: Scope
    needs_token: bool


class Guarded:
    """Refuses what comes from elsewhere, and adds the headers that keep a page to itself."""

    def __init__(
        self, app: ASGIApp, guard: Guard, places: Places, *, ancestors: tuple[str, ...] = ()
    ) -> None:
        self._app = app
        self._guard, self._places = guard, places
        self._headers = {
            b"content-security-policy": (_CSP + " ".join(("'self'", *ancestors))).encode(),
            b"x-content-type-options": b"nosniff",
            b"referrer-policy": b"no-referrer",
            b"cross-origin-resource-policy": b"same-origin",
            b"cache-control": b"no-store",
        }

    async def __call__(self, scope: Connection, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it."""
        if scope["type"] != "http":
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                have = {name.lower() for name, _ in message["headers"]}
                extra = [item for item in self._headers.items() if item[0] not in have]
                message = {**message, "headers": [*message["headers"], *extra]}
            # A browser that does not read is let go; until then it costs one message.
            await asyncio.wait_for(send(message), SEND_WITHIN_S)

        with (
            self._places.serving(scope["client"]) as keep,
            suppress(TimeoutError, ConnectionError),
        ):
            app, receive = await self._answering(asked_of(scope), receive, keep)
            await app(scope, receive, sent)

    async def _answering(
        self, asked: Asked, receive: Receive, keep: Callable[[], None]
    ) -> tuple[ASGIApp, Receive]:
        """Return what answers a request, and what that may still read."""
        now_s = since_start_s()
        refusal = self._guard.refusal(asked, now_s)
        if refusal is None and asked.method == "POST" and not self._guard.is_upload(asked.path):
            try:
                async with asyncio.timeout(BODY_WITHIN_S):
                    body = await _body(receive)
            except TimeoutError:
                refusal = 408, f"a request has to arrive within {BODY_WITHIN_S:g} s"
            else:
                receive = _replay(body, receive)
                if len(body) > BODY_BYTES_MAX:
                    refusal = 413, f"a request has at most {BODY_BYTES_MAX} bytes"
        if refusal is not None:
            return JSONResponse({"detail": refusal[1]}, refusal[0]), receive
        if self._guard.keeps_place(asked, now_s):
            keep()
        return self._app, receive


def asked_of(scope: Connection) -> Asked:
    """Return what of a request the guard looks at."""
    headers = tuple((k.decode("latin-1").lower(), v.decode("latin-1")) for k, v in scope["headers"])
    return Asked(method=scope["method"], path=scope["path"], headers=headers)


async def _body(receive: Receive) -> bytes:
    """Return a request's body, or more than it may have."""
    body = b""
    while len(body) <= BODY_BYTES_MAX:
        message = await receive()
        body += bytes(message.get("body", b""))
        if message["type"] == "http.disconnect" or not message.get("more_body"):
            break
    return body


def _replay(body: bytes, receive: Receive) -> Receive:
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed


async def unusable(_request: Request, error: Exception) -> Response:
    """Say what is wrong with a request, without repeating what was in it."""
    found = error.errors() if isinstance(error, RequestValidationError) else []
    where = ".".join(str(part) for part in found[0]["loc"]) if found else "request"
    text = str(found[0]["msg"]) if found else "cannot be used"
    return JSONResponse({"detail": f"{where[:80]}: {text[:200]}"}, 422)


def add_sessions(app: FastAPI, guard: Guard, *, login_s: int, is_tls: bool) -> None:
    """Add what opens a session by a token, and says what one may do.

    Wrong tokens are not counted: nobody guesses 256 bits, and behind a proxy all have one address.
    """

    @app.get(f"{API}session", tags=["session"])
    async def access(request: Request) -> Access:
        """Return what one may do."""
        scope = guard.scope_of(asked_of(request.scope), since_start_s())
        return Access(scope=scope, needs_token=guard.doors.needs_token)

    @app.post(f"{API}session", tags=["session"], responses=REFUSED)
    async def log_in(login: Login, response: Response) -> Access:
        """Open a session by a token; the session is a cookie that scripts cannot read."""
        scope = guard.tokens.scope_of(login.token)
        if scope == "none":
            raise HTTPException(401, "this token is not valid; take the newest link")
        value = session(guard.tokens, scope, int(since_start_s()) + login_s)
        response.set_cookie(
            COOKIE,
            value,
            max_age=login_s,
            httponly=True,
            samesite="strict",
            secure=is_tls,
        )
        return Access(scope=scope, needs_token=guard.doors.needs_token)


def server_of(
    app: Guarded,
    *,
    tls: tuple[str, str] | None,
    shutdown_within_s: int | None = None,
) -> uvicorn.Server:
    """Return what serves a page on a socket of ours, which `Places` guards.

    It says nothing of itself to strangers, and strangers write no line into its log.
    """
    certificate, key = tls or (None, None)
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            lifespan="off",
            log_level="error",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            loop="asyncio",
            backlog=AT_ONCE,
            timeout_keep_alive=round(WAIT_S),
            timeout_graceful_shutdown=shutdown_within_s,
            h11_max_incomplete_event_size=16_384,
            ssl_certfile=certificate,
            ssl_keyfile=key,
        )
    )

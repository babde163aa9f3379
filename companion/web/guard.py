"""Who may ask the page for what: hosts, origins, tokens, sessions and limits. Pure but for files.

A page in somebody's browser can send requests to any address. So the Host header must be an
address of ours (a name that an attacker rebinds to our address is refused), and an order's Origin
must be the page itself. A token opens a session with a scope: `view` or `operate`. The session is
a signed cookie, so it outlives the page's process; new tokens and a new start of the computer end
all sessions. They are timed since that start: a board without a battery for its clock does not know
the date until it is told, and what it is told is no reason to end a session, or to let one live.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import json
import os
import re
import secrets
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from companion.errors import ConfigError

Scope = Literal["none", "view", "operate"]
RANK: dict[Scope, int] = {"none": 0, "view": 1, "operate": 2}
TOKEN_BYTES = 32
_NETLOC = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(:[0-9]{1,5})?", re.IGNORECASE)
COOKIE = "vrspray_session"


@cache
def _start() -> str:
    """Return what names this start of the computer; where there is no name, of this process."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
    except OSError:
        return secrets.token_hex()


def since_start_s() -> float:
    """Return the time since the computer started; nobody sets this clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tokens:
    """The page's two secrets."""

    view: str
    operate: str

    def scope_of(self, token: str) -> Scope:
        """Return what a token allows."""
        given = token.encode("utf-8", "replace")
        if hmac.compare_digest(given, self.operate.encode()):
            return "operate"
        return "view" if hmac.compare_digest(given, self.view.encode()) else "none"

    @property
    def key(self) -> bytes:
        """Return the key that signs sessions; another with new tokens or a new start."""
        return hashlib.sha256(f"session {_start()} {self.view} {self.operate}".encode()).digest()


def new_tokens(path: Path) -> Tokens:
    """Write a new pair of tokens into a file that only its owner can read, and return it."""
    tokens = Tokens(
        view=secrets.token_urlsafe(TOKEN_BYTES), operate=secrets.token_urlsafe(TOKEN_BYTES)
    )
    text = json.dumps({"view": tokens.view, "operate": tokens.operate}) + "\n"
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot keep the page's tokens ({(error.strerror or '').lower()}); set "
            "link.state_folder to a folder that can be written"
        ) from error
    return tokens


def kept_tokens(path: Path) -> Tokens:
    """Return the tokens in a file, new ones where there is none; a `ConfigError` for a bad file."""
    try:
        with path.open("rb") as file:
            is_shared = os.fstat(file.fileno()).st_mode & 0o077
            found = json.loads(file.read(4096))
        tokens = Tokens(view=str(found["view"]), operate=str(found["operate"]))
    except FileNotFoundError:
        return new_tokens(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: no tokens of the page; remove the file, or run vrspray token rotate"
        ) from error
    if is_shared or min(len(tokens.view), len(tokens.operate)) < TOKEN_BYTES:
        raise ConfigError(
            f"{path}: others can read the page's tokens, or they are too short; run vrspray token "
            "rotate"
        )
    return tokens


def session(tokens: Tokens, scope: Scope, until_s: int) -> str:
    """Return a session's cookie: scope and end, signed."""
    text = f"{scope}.{until_s}"
    signature = hmac.new(tokens.key, text.encode(), hashlib.sha256).hexdigest()
    return f"{text}.{signature}"


def session_scope(tokens: Tokens, cookie: str, now_s: float) -> Scope:
    """Return what a cookie allows; nothing where it is not ours, or over."""
    scope, _, rest = cookie.partition(".")
    until, _, signature = rest.partition(".")
    if scope not in ("view", "operate") or not (until.isascii() and until.isdecimal()):
        return "none"
    expected = hmac.new(tokens.key, f"{scope}.{until}".encode(), hashlib.sha256).hexdigest()
    if not hmac.compare_digest(signature.encode("utf-8", "replace"), expected.encode()):
        return "none"
    if not now_s < int(until[:12]):
        return "none"
    return "operate" if scope == "operate" else "view"


def host_of(netloc: str) -> str | None:
    """Return the host in a Host header or an origin, in small letters; None for what is none.

    >>> host_of("192.168.1.5:8880"), host_of("[::1]:8880"), host_of("a@b"), host_of("")
    ('192.168.1.5', '::1', None, None)
    """
    if not _NETLOC.fullmatch(netloc):
        return None
    try:
        parts = urlsplit(f"//{netloc}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    return None if port is not None and not port else host


def is_loopback(host: str) -> bool:
    """Return whether an address reaches this computer only.

    >>> is_loopback("127.0.0.1"), is_loopback("::1"), is_loopback("0.0.0.0")
    (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Doors:
    """By which names the page may be called; `is_local`: it listens on loopback only.

    A name stands for itself at `port` and at the port that browsers leave out, unless it has one:
    what other ports of that name serve is not the page.
    """

    is_local: bool
    names: tuple[str, ...] = ()
    port: int = 0

    @property
    def needs_token(self) -> bool:
        """Return whether whoever looks must say who he is: all but this computer's own users."""
        return not self.is_local or bool(self.names)

    def allows_host(self, netloc: str) -> bool:
        """Return whether a Host header names us: an address, localhost, a .local or a given name.

        >>> lan = Doors(is_local=False)
        >>> lan.allows_host("192.168.1.5:8880"), lan.allows_host("sprayer.local:8880")
        (True, True)
        >>> lan.allows_host("evil.example:8880"), Doors(is_local=True).allows_host("10.0.0.1")
        (False, False)
        """
        host = host_of(netloc)
        if host is None:
            return False
        if is_loopback(host) or self._is_named(netloc):
            return True
        if self.is_local:
            return False
        try:
            ipaddress.ip_address(host)
        except ValueError:
            return host.endswith(".local")
        return True

    def _is_named(self, netloc: str) -> bool:
        netloc = netloc.lower()
        name, _, port = netloc.rpartition(":")
        return netloc in self.names or (port == str(self.port) and name in self.names)

    def allows_origin(self, origin: str, netloc: str) -> bool:
        """Return whether an order's Origin is the page itself, as this request calls it.

        A proxy may add TLS or change the port: then the name must be one that was given.
        """
        scheme, separator, place = origin.partition("://")
        if not separator or scheme not in ("http", "https"):
            return False
        if not self.allows_host(place):
            return False
        return place.lower() == netloc.lower() or self._is_named(place)


API = "/api/v1/"
# Without a session one may load the page itself, log in, and stop.
_READ_OPEN = frozenset({f"{API}session", f"{API}openapi.json"})
_ORDER_OPEN = frozenset({f"{API}session", f"{API}stop"})
_NO_ORIGIN = frozenset({f"{API}stop"})

Refusal = tuple[int, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What of a request decides whether it is answered; header names in small letters."""

    method: str
    path: str
    headers: tuple[tuple[str, str], ...]

    def header(self, name: str) -> str | None:
        """Return a header; None where it is missing."""
        return next((value for key, value in self.headers if key == name), None)

    def cookie(self, name: str) -> str:
        """Return a cookie's value; nothing where it is missing."""
        for pair in (self.header("cookie") or "").split(";"):
            key, _, value = pair.strip().partition("=")
            if key == name:
                return value
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """Answers who a request comes from, and why it is refused."""

    doors: Doors
    tokens: Tokens
    # Below these paths a body is a file, whose size its own handler limits.
    uploads: tuple[str, ...] = ()
    # What a refusal tells to do: the setting of the names, and the command that prints the link.
    names_by: str = "web.names"
    printed_by: str = "vrspray token show"

    def is_upload(self, path: str) -> bool:
        """Return whether the body of a POST is a file."""
        return path.startswith(self.uploads)

    def keeps_place(self, asked: Asked, now_s: float) -> bool:
        """Return whether nobody who comes later may push a request aside: a STOP, a session."""
        return asked.path in _NO_ORIGIN or self.scope_of(asked, now_s) != "none"

    def scope_of(self, asked: Asked, now_s: float) -> Scope:
        """Return what a request may do, by its token or its session."""
        if not self.doors.needs_token:
            return "operate"
        kind, _, token = (asked.header("authorization") or "").partition(" ")
        if kind.lower() == "bearer":
            return self.tokens.scope_of(token.strip())
        return session_scope(self.tokens, asked.cookie(COOKIE), now_s)

    def refusal(self, asked: Asked, now_s: float) -> Refusal | None:
        """Return status and text where a request is refused; None where it may go on."""
        hosts = [value for key, value in asked.headers if key == "host"]
        if len(hosts) != 1 or not self.doors.allows_host(hosts[0]):
            return 421, f"this address does not belong to the page; add it to {self.names_by}"
        if asked.method in ("GET", "HEAD"):
            is_open = not asked.path.startswith(API) or asked.path in _READ_OPEN
            needs: Scope = "none" if is_open else "view"
        elif asked.method == "POST":
            foreign = self._foreign(asked, hosts[0])
            if foreign is not None:
                return foreign
            needs = "none" if asked.path in _ORDER_OPEN else "operate"
        else:
            return 405, "only GET and POST"
        scope = self.scope_of(asked, now_s)
        if RANK[scope] >= RANK[needs]:
            return None
        if scope == "none":
            return 401, f"open the link, or scan the QR code, that {self.printed_by} prints"
        return 403, "this link may only look; an order needs the operator's link"

    def _foreign(self, asked: Asked, host: str) -> Refusal | None:
        """Return why an order does not come from the page itself."""
        origin = asked.header("origin")
        if origin is not None:
            if not self.doors.allows_origin(origin, host):
                return 403, "an order must come from the page itself"
        elif asked.header("authorization") is None and asked.path not in _NO_ORIGIN:
            return 403, "an order needs an Origin, or a token as Authorization: Bearer"
        kind = (asked.header("content-type") or "").partition(";")[0].strip().lower()
        if self.is_upload(asked.path):
            # Like JSON it is none of the types that another page's form can send.
            if kind != "application/octet-stream":
                return 415, "a file is bytes; send Content-Type: application/octet-stream"
        elif kind != "application/json":
            return 415, "an order is JSON; send Content-Type: application/json"
        return None

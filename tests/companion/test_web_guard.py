"""Who may ask the page for what: the table of docs/safety.md, over real sockets."""

from __future__ import annotations

import asyncio
import stat
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio
from fastapi import FastAPI

from companion.errors import ConfigError
from companion.web.entrance import Guarded, add_sessions
from companion.web.guard import (
    API,
    COOKIE,
    Doors,
    Guard,
    Tokens,
    host_of,
    kept_tokens,
    new_tokens,
    session,
    session_scope,
    since_start_s,
)
from companion.web.places import Places
from tests.companion.web_site import OPERATE, VIEW, Site, ask, in_process, served

IN_LOOP = pytest.mark.asyncio(loop_scope="module")

TOKENS = Tokens(view=VIEW, operate=OPERATE)
ALL_ORDERS = ("stop", "hold", "enable", "disable", "refilled", "declare")


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def cookie(scope: str, until_s: float = 1e9, tokens: Tokens = TOKENS) -> dict[str, str]:
    return {"Cookie": f"{COOKIE}={session(tokens, scope, int(until_s))}"}  # type: ignore[arg-type]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def page() -> AsyncIterator[Site]:
    """Yield a page as phones in the field call it: with a token. One for all: it starts slowly."""
    async with served(is_local=False, names=["sprayer.example", "proxy.example:8443"]) as site:
        yield site


@pytest.fixture
def lan(page: Site) -> Site:
    page.orders.clear()
    return page


@IN_LOOP
async def test_a_request_with_a_foreign_host_is_refused_whatever_it_asks(lan: Site) -> None:
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "a@127.0.0.1", ""):
        for method, path in (("GET", "/"), ("GET", "/api/v1/state"), ("POST", "/api/v1/stop")):
            reply = await lan.asked(method, path, headers=bearer(OPERATE), host=host)
            assert reply.status in (400, 421), (host, path, reply)
    assert not lan.orders


@IN_LOOP
async def test_hosts_that_are_ours_are_answered(lan: Site) -> None:
    names = ("sprayer.example", f"Sprayer.example:{lan.port}", "proxy.example:8443")
    for host in ("127.0.0.1:1", "localhost", "[::1]:8", "10.1.2.3", "pi.local", *names):
        reply = await lan.asked("GET", "/api/v1/state", headers=bearer(VIEW), host=host)
        assert reply.status == 200, host


@IN_LOOP
async def test_an_order_from_another_page_is_refused(lan: Site) -> None:
    port = lan.port
    for origin in (
        "http://evil.example",
        f"http://evil.example:{port}",
        "null",
        "http://127.0.0.1:1",
        f"file://127.0.0.1:{port}",
        f"http://127.0.0.1:{port}/path",
        f"http://a@127.0.0.1:{port}",
    ):
        for name in ALL_ORDERS:
            headers = {"Origin": origin, **bearer(OPERATE)}
            reply = await lan.asked("POST", f"/api/v1/{name}", headers=headers)
            assert reply.status == 403, (origin, name)
    assert not lan.orders


@IN_LOOP
async def test_a_name_is_no_licence_for_what_its_other_ports_serve(lan: Site) -> None:
    own = f"sprayer.example:{lan.port}"
    for host in ("sprayer.example:81", "proxy.example", f"proxy.example:{lan.port}"):
        assert (await lan.asked("GET", "/", host=host)).status == 421, host
    for origin, status in (
        ("http://sprayer.example:81", 403), ("http://proxy.example", 403),
        ("http://sprayer.example", 200), (f"http://{own}", 200),
        ("https://proxy.example:8443", 200),
    ):  # fmt: skip
        headers = {"Origin": origin, **bearer(OPERATE)}
        reply = await lan.asked("POST", "/api/v1/disable", headers=headers, host=own)
        assert reply.status == status, origin


@IN_LOOP
async def test_stop_needs_no_session_and_no_origin_and_everything_else_does(lan: Site) -> None:
    assert (await lan.asked("POST", "/api/v1/stop")).json["accepted"]
    assert (await lan.asked("POST", "/api/v1/stop", headers={"Origin": ""})).json["accepted"]
    assert [order.name for order in lan.orders] == ["stop", "stop"]
    for name in ALL_ORDERS[1:]:
        assert (await lan.asked("POST", f"/api/v1/{name}")).status == 401, name
        no_origin = {"Origin": "", **cookie("operate")}
        assert (await lan.asked("POST", f"/api/v1/{name}", headers=no_origin)).status == 403
    for path in ("state", "events", "map", "facts", "track"):
        assert (await lan.asked("GET", f"/api/v1/{path}")).status == 401, path
    for path in ("/", "/static/page.js", "/register_service", "/api/v1/session"):
        assert (await lan.asked("GET", path)).status == 200, path
    assert len(lan.orders) == 2


@pytest.mark.parametrize(
    "wrong", ["", "x", OPERATE[:-1], OPERATE + "o", "Ω" * 20, "v.9999999999.0"]
)
@IN_LOOP
async def test_wrong_tokens_and_cookies_open_nothing(lan: Site, wrong: str) -> None:
    for headers in (bearer(wrong), {"Cookie": f"{COOKIE}={wrong}"}):
        raw = {name: value.encode().decode("latin-1") for name, value in headers.items()}
        assert (await lan.asked("GET", "/api/v1/state", headers=raw)).status == 401
        assert (await lan.asked("POST", "/api/v1/disable", headers=raw)).status == 401


@IN_LOOP
async def test_a_session_is_over_in_time_with_new_tokens_and_with_a_new_start(
    lan: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    over = cookie("operate", until_s=since_start_s() - 1)
    other = cookie("operate", tokens=Tokens(view="w" * 43, operate=OPERATE))
    forged = {"Cookie": cookie("view")["Cookie"].replace("view", "operate")}
    monkeypatch.setattr("companion.web.guard._start", lambda: "another start of the computer")
    before = cookie("operate")
    monkeypatch.undo()
    for headers in (over, other, forged, before):
        assert (await lan.asked("GET", "/api/v1/state", headers=headers)).status == 401
    assert (await lan.asked("GET", "/api/v1/state", headers=cookie("view"))).status == 200


@IN_LOOP
async def test_who_may_look_may_stop_and_nothing_else(lan: Site) -> None:
    for name in ALL_ORDERS[1:]:
        assert (await lan.asked("POST", f"/api/v1/{name}", headers=cookie("view"))).status == 403
        assert (await lan.asked("POST", f"/api/v1/{name}", headers=bearer(VIEW))).status == 403
    assert not lan.orders
    assert (await lan.asked("POST", "/api/v1/stop", headers=cookie("view"))).status == 200


@IN_LOOP
async def test_a_token_opens_a_session_that_scripts_cannot_read(lan: Site) -> None:
    reply = await lan.asked("POST", "/api/v1/session", {"token": OPERATE})
    assert reply.json == {"scope": "operate", "needs_token": True}
    set_cookie = reply.headers["set-cookie"]
    assert "HttpOnly" in set_cookie
    assert "samesite=strict" in set_cookie.lower()
    headers = {"Cookie": set_cookie.partition(";")[0]}
    assert (await lan.asked("POST", "/api/v1/disable", headers=headers)).json["accepted"]


@IN_LOOP
async def test_who_guesses_locks_nobody_out_who_has_the_same_address(lan: Site) -> None:
    guess = ("POST", "/api/v1/session", {"token": "x"})
    assert {(await lan.asked(*guess)).status for _ in range(30)} == {401}
    right = await lan.asked("POST", "/api/v1/session", {"token": OPERATE})
    assert right.json["scope"] == "operate"
    assert (await lan.asked("POST", "/api/v1/stop")).status == 200


@pytest.mark.parametrize("jump_s", [2e9, -2e9])
async def test_a_clock_that_is_set_ends_no_session_and_lengthens_none(
    monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    guard = Guard(doors=Doors(is_local=False), tokens=TOKENS)
    app = FastAPI()
    add_sessions(app, guard, login_s=3600, is_tls=False)
    places, session_at, now_s = Places(), f"{API}session", time.time()
    async with in_process(Guarded(app, guard, places), places) as port:
        opened = await asyncio.to_thread(ask, port, "POST", session_at, {"token": OPERATE})
        mine = {"Cookie": opened.headers["set-cookie"].partition(";")[0]}

        async def scope() -> object:
            reply = await asyncio.to_thread(ask, port, "GET", session_at, headers=mine)
            return reply.json["scope"]

        monkeypatch.setattr(time, "time", lambda: now_s + jump_s)
        assert await scope() == "operate"
        monkeypatch.setattr("companion.web.entrance.since_start_s", lambda: since_start_s() + 3601)
        assert await scope() == "none"


@IN_LOOP
async def test_bodies_are_small_json_of_the_expected_form(lan: Site) -> None:
    operate = cookie("operate")
    for body in (
        b"",
        b"{",
        b"[]",
        b"null",
        b'{"litres": "NaN"}',
        b'{"litres": NaN}',
        b'{"litres": -1}',
    ):
        reply = await lan.asked("POST", "/api/v1/refilled", body, operate)
        assert reply.status == 422, body
    for body in (b'{"litres": 1, "more": 1}', b"[" * 2000, b'{"litres": 1e999}', b"\xff\xfe"):
        reply = await lan.asked("POST", "/api/v1/refilled", body, operate)
        assert reply.status in (400, 422), body
    large = b'{"litres": 1' + b" " * 5000 + b"}"
    assert (await lan.asked("POST", "/api/v1/refilled", large, operate)).status == 413
    form = operate | {"Content-Type": "application/x-www-form-urlencoded"}
    assert (await lan.asked("POST", "/api/v1/refilled", b"litres=1", form)).status == 415
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH"):
        assert (await lan.asked(method, "/api/v1/stop", headers=operate)).status == 405
    assert not lan.orders
    assert (await lan.asked("POST", "/api/v1/refilled", {"litres": 12.5}, operate)).json["accepted"]
    assert lan.orders[0].value == 12.5


SEEN = {"observed_at": "2026-05-01T06:30:00Z", "wind_m_s": 2.5, "inversion": "no"}


@IN_LOOP
async def test_a_declaration_is_bounded_and_says_when(lan: Site) -> None:
    operate = cookie("operate")
    for change in (
        {"observed_at": None}, {"observed_at": "now"}, {"wind_m_s": -1.0}, {"wind_m_s": 61.0},
        {"wind_from_deg": 361.0}, {"temperature_c": 61.0}, {"humidity_percent": 101.0},
        {"inversion": "perhaps"}, {"droplet_class": "x" * 41}, {"pilot": "somebody"},
    ):  # fmt: skip
        reply = await lan.asked("POST", "/api/v1/declare", SEEN | change, operate)
        assert reply.status == 422, change
    assert not lan.orders
    given = SEEN | {"droplet_class": "coarse"}
    assert (await lan.asked("POST", "/api/v1/declare", given, operate)).json["accepted"]
    assert dict(lan.orders[0].said) == {
        "application.observed_at": "2026-05-01T06:30:00Z", "application.wind_m_s": 2.5,
        "application.inversion": "no", "product.droplet_class": "coarse",
    }  # fmt: skip


@IN_LOOP
async def test_no_file_outside_the_page_is_served(lan: Site) -> None:
    for path in (
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        "/static//etc/passwd",
        "/static/",
        "/static/..%2fserver.py",
        "/static/%00",
        "/static/vendor",
    ):
        assert (await lan.asked("GET", path)).status == 404, path


@IN_LOOP
async def test_every_answer_keeps_the_page_to_itself(lan: Site) -> None:
    for method, path in (("GET", "/"), ("GET", "/nothing"), ("POST", "/api/v1/hold")):
        headers = (await lan.asked(method, path)).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'self'" in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


@IN_LOOP
async def test_enabling_takes_a_press_of_a_second_that_no_stop_came_between(lan: Site) -> None:
    async def press() -> dict[str, str]:
        reply = await lan.asked("POST", "/api/v1/hold", headers=operate)
        return {"ticket": reply.json["ticket"]}

    async def enable(ticket: dict[str, str]) -> bool:
        reply = await lan.asked("POST", "/api/v1/enable", ticket, operate)
        return bool(reply.json["accepted"])

    operate = cookie("operate")
    short, stopped = await press(), await press()
    assert not await enable(short)
    await lan.asked("POST", "/api/v1/stop")
    held = await press()
    await asyncio.sleep(1.0)  # the press itself
    assert not await enable(stopped)
    assert await enable(held)
    assert not await enable(held)
    assert [order.name for order in lan.orders] == ["stop", "enable"]


async def test_on_loopback_alone_this_computers_users_need_no_token() -> None:
    async with served() as site:
        assert (await site.asked("GET", "/api/v1/state")).status == 200
        assert (await site.asked("GET", "/api/v1/session")).json["needs_token"] is False
        assert (await site.asked("GET", "/api/v1/state", host="192.168.1.2")).status == 421
        assert (await site.asked("GET", "/api/v1/state", host="pi.local")).status == 421
        foreign = {"Origin": "http://evil.example"}
        assert (await site.asked("POST", "/api/v1/disable", headers=foreign)).status == 403
        assert (await site.asked("POST", "/api/v1/disable")).json["accepted"]


def test_doors_know_names_whatever_their_case() -> None:
    doors = Doors(is_local=True, names=("blueos.local",))
    assert doors.needs_token
    assert doors.allows_host("BLUEOS.local")
    assert doors.allows_origin("https://blueos.local", "blueos.local:80")
    assert not doors.allows_origin("https://other.local", "other.local")
    for netloc in ("a b", "127.0.0.1:x", "[::1", "h/p", "h?x", "h#x", ":80", "h:99999"):
        assert host_of(netloc) is None, netloc


def test_sessions_are_read_strictly() -> None:
    for text in ("", ".", "operate", "operate.1", "operate.²." + "0" * 64, "admin.9999999999.x"):
        assert session_scope(TOKENS, text, 0.0) == "none"


def test_tokens_are_kept_for_their_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "state" / "tokens.json"
    first = kept_tokens(path)
    assert kept_tokens(path) == first
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert new_tokens(path) != first
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="vrspray token rotate"):
        kept_tokens(path)
    path.chmod(0o600)
    path.write_text("{}")
    with pytest.raises(ConfigError, match="no tokens"):
        kept_tokens(path)

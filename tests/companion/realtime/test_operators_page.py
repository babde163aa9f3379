"""The operator's page in a real browser, beside a companion that flies over a socket.

Needs Chromium (`apt-get install chromium`); without it these tests are skipped.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
import pytest
from axe_playwright_python.async_playwright import Axe
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from playwright.async_api import Browser, Locator, Page, async_playwright, expect
from playwright.async_api import TimeoutError as PlaywrightTimeout

from companion.cli.web_parts import Watched, obeying
from companion.doctor.check import Status
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.map_pictures import RATES_MAP, rate_ends
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import run
from companion.web import OperatorPage, listen
from tests.companion.realtime.client_bench import flying_bench, passes, prescribed_l
from tests.companion.test_run_flight import CHANNELS, SETUP, Notes
from tests.companion.web_site import about
from tests.companion.wire_peer import WirePeer, free_port, over_udp
from tests.quickest import quickest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.sitl,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
ARGUMENTS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
WITHOUT_WEBGL = [*ARGUMENTS, "--disable-gpu", "--disable-3d-apis", "--disable-software-rasterizer"]
expect.set_options(timeout=30_000)
PRESSED = re.compile(r"\bpressed\b")
SERIOUS = ("serious", "critical")
# From the touch to the last valve's order on the wire.
STOP_WITHIN_S = 0.3


@dataclass
class Flight:
    """A companion with its page, and the autopilot that it flies with."""

    peer: WirePeer
    url: str
    notes: Notes
    page: OperatorPage
    requests: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)

    async def open(self, browser: Browser, **options: Any) -> Page:
        context = await browser.new_context(**options)
        page = await context.new_page()
        page.set_default_timeout(30_000)
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.troubles.append(str(error)))
        page.on("console", lambda said: said.type == "error" and self.troubles.append(said.text))
        await page.goto(self.url)
        await page.wait_for_function("() => document.body.dataset.map === 'ready'")
        return page

    @property
    def child(self) -> subprocess.Popen[bytes]:
        assert self.page._child is not None
        return self.page._child

    async def until_spraying(self) -> None:
        self.peer.place(east_m=2.0)
        await self.peer.until(lambda: len(self.peer.open_channels) == len(CHANNELS))


async def shows(page: Page, state: str) -> None:
    """Wait until the page says so; else tell what it says instead, with its reasons."""
    try:
        await page.wait_for_function(
            "(state) => document.getElementById('state').dataset.state === state", arg=state
        )
    except PlaywrightTimeout:
        said = [await page.locator(place).inner_text() for place in ("#state", "#alarms")]
        pytest.fail(f"no {state!r}; the page says {said}")


@pytest.fixture
async def flight(tmp_path: Path) -> AsyncIterator[Flight]:
    """Yield a companion, its page, and a vehicle that flies over the field."""
    port, notes = free_port(), Notes()
    listener = listen("127.0.0.1", 0)
    url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions(page_may_enable=True))
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    link.on_order_ack(executor.acknowledge)
    page = OperatorPage(listener, about(tmp_path), obey=obeying(link), horizon_s=SETUP.longest_s)
    task = asyncio.create_task(
        run(SETUP, link=link, executor=executor, recorder=Watched(notes, page), sensors=[page])
    )
    async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
        await peer.until(lambda: bool(peer.outputs), within_s=30.0)
        yield Flight(peer, url, notes, page)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@contextlib.asynccontextmanager
async def chromium(arguments: list[str] = ARGUMENTS) -> AsyncIterator[Browser]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield browser
        finally:
            await browser.close()


@contextlib.asynccontextmanager
async def answered(page: Page, place: str) -> AsyncIterator[None]:
    """Wait until the page has been answered what is asked inside, and shows it."""
    async with page.expect_response(lambda found: found.url.endswith(f"/api/v1/{place}")):
        yield
    await page.wait_for_function("() => !document.body.dataset.busy")


async def enable(page: Page) -> None:
    """Hold the button that enables, once the page offers that, for as long as it wants."""
    await _hold(page, "Hold to enable")


async def release(page: Page) -> None:
    """Hold the button that releases STOP, once the page offers that, for as long as it wants."""
    await _hold(page, "Hold to release STOP")


async def hold_key(page: Page, label: str, key: str) -> None:
    """Press a key on the button too short, then as long as it wants, as it repeats by itself."""
    button = await _offered(page, label)
    await button.focus()
    await page.keyboard.press(key)
    await expect(page.locator("#answer")).to_have_text("Keep the button pressed for a second.")
    await expect(button).to_have_text(label)
    await page.keyboard.down(key)
    await page.keyboard.down(key)
    await expect(button).not_to_have_class(PRESSED)
    await page.keyboard.up(key)


async def _offered(page: Page, label: str) -> Locator:
    button = page.locator("#enable")
    await expect(button).to_have_text(label)
    await expect(button).to_be_enabled()
    return button


async def _hold(page: Page, label: str) -> None:
    button = await _offered(page, label)
    await button.hover()
    await page.mouse.down()
    await expect(button).not_to_have_class(PRESSED)
    await page.mouse.up()


@pytest.mark.timeout(180)
async def test_a_flight_is_watched_stopped_released_and_enabled_from_the_page(
    flight: Flight,
) -> None:
    peer = flight.peer
    async with chromium() as browser:
        page = await flight.open(browser, viewport={"width": 390, "height": 844}, has_touch=True)
        second = await flight.open(browser, viewport={"width": 1280, "height": 800})
        peer.place(east_m=2.0)
        await shows(page, "ready")
        await enable(page)

        async def closing_s() -> float:
            if not peer.is_spraying:
                await flight.until_spraying()
            await shows(page, "spraying")
            await page.locator("#stop").hover()
            pressed_s = time.monotonic()
            await page.mouse.down()
            await peer.until(lambda: peer.is_all_closed)
            closed = len(peer.orders)
            took_s = peer.orders[-1].at_s - pressed_s
            await page.mouse.up()
            await shows(page, "estop")
            await shows(second, "estop")
            peer.enable()  # latched: enabling by another way opens nothing
            await release(page)
            peer.place(east_m=2.0)
            await shows(page, "ready")
            assert all(order.pulse_us == 1000 for order in peer.orders[closed:])
            await enable(page)
            return took_s

        assert await quickest(closing_s, within_s=STOP_WITHIN_S, tries=3) <= STOP_WITHIN_S
        await flight.until_spraying()
        await expect(page.locator("#numbers")).to_contain_text(
            re.compile("Applied in all0[.][1-9]")
        )
        await page.wait_for_function("() => document.getElementById('n-target').textContent > '10'")
        hosts = {urlsplit(url).netloc for url in flight.requests}
        assert hosts == {urlsplit(flight.url).netloc}
        assert not flight.troubles


@pytest.mark.timeout(120)
async def test_without_webgl_the_page_draws_on_a_canvas_and_the_keyboard_is_enough(
    flight: Flight,
) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await flight.open(browser, viewport={"width": 360, "height": 740})
        assert await page.evaluate("() => document.getElementById('map').dataset.kind") == "canvas"
        flight.peer.place(east_m=2.0)
        await hold_key(page, "Hold to enable", " ")
        await flight.until_spraying()
        await shows(page, "spraying")
        width = await page.evaluate("() => document.documentElement.scrollWidth")
        assert width == 360
        await page.locator("#stop").focus()
        await page.keyboard.press("Enter")
        await flight.peer.until(lambda: flight.peer.is_all_closed)
        await shows(page, "estop")
        await hold_key(page, "Hold to release STOP", "Enter")
        await expect(page.locator("#enable")).to_have_text("Hold to enable")
        await page.locator("#units").select_option("us")
        await expect(page.locator("#rates")).to_contain_text("gal/ac")
        await page.locator("#theme").select_option("night")
        await expect(page.locator("html")).to_have_attribute("data-theme", "night")
        assert not flight.troubles


@pytest.mark.timeout(120)
@pytest.mark.parametrize("arguments", [ARGUMENTS, WITHOUT_WEBGL], ids=["webgl", "canvas"])
async def test_treated_ground_is_coloured_by_rate_or_by_error(
    flight: Flight, arguments: list[str]
) -> None:
    async with chromium(arguments) as browser:
        page = await flight.open(browser, viewport={"width": 600, "height": 900})
        await shows(page, "ready")
        await enable(page)
        await flight.until_spraying()
        await page.wait_for_function("() => document.getElementById('n-target').textContent > '10'")
        button = page.get_by_role("button", name="Error")
        await expect(page.locator("#legend")).to_contain_text("map · done")
        await button.click()
        await expect(button).to_have_attribute("aria-pressed", "true")
        await expect(page.locator("#legend")).to_contain_text("% off")
        await page.get_by_role("button", name="STOP").click()
        await shows(page, "estop")
        off = await page.evaluate(OFF_BY, "static/geo.js")
        # 20 L/ha wanted: applied, too little, much too much, and a change that is under way.
        assert off == [0, pytest.approx(-0.15), pytest.approx(0.5), 0, None]
        # A rate has the colour that it has on all other pictures of the map.
        for rates in ([0.0, 15.0, 25.0], [20.0], [0.0]):
            colours = await page.evaluate(COLOURS_OF, ["static/geo.js", rates])
            scale = ScalarMappable(Normalize(*rate_ends(rates)), RATES_MAP)
            wanted = scale.to_rgba(np.array(rates), bytes=True)[:, :3].astype(float)
            near = [found for rate, found in zip(rates, colours, strict=True) if rate]
            assert np.array(near).reshape(-1, 3) == pytest.approx(
                wanted[np.array(rates) > 0], abs=6
            )
        assert not flight.troubles


COLOURS_OF = """async ([place, rates]) => {
  const { Scale } = await import(new URL(place, document.baseURI).href);
  const scale = new Scale(rates, "day");
  return rates.map((rate) => scale.color(rate).match(/\\d+/g).map(Number));
}"""

OFF_BY = """async (place) => {
  const { offBy } = await import(new URL(place, document.baseURI).href);
  const off = (rate, ...wanted) => offBy(
    wanted.map((one, k) => [k * 0.1, 0, 0, 0, "1", rate, one]), 0, 0.2);
  return [off(20, 20), off(17, 20, 20), off(30, 20, 20, 20, 20, 30),
    off(30, 20, 20, 20, 30), off(20, null)];
}"""


@pytest.mark.timeout(120)
async def test_a_page_without_news_says_so_and_greys_what_is_old(flight: Flight) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await flight.open(browser)
        await shows(page, "ready")
        flight.child.send_signal(signal.SIGSTOP)
        await page.wait_for_function("() => document.body.classList.contains('stale')")
        await expect(page.locator("#lost")).to_be_visible()
        await expect(page.locator("#state-word")).to_have_text("LINK LOST")
        await page.locator("#stop").click()
        await expect(page.locator("#answer")).to_contain_text("NOT CONFIRMED")
        flight.child.send_signal(signal.SIGCONT)
        await page.wait_for_function("() => !document.body.classList.contains('stale')")


@pytest.mark.timeout(120)
async def test_the_checklist_names_what_to_see_to_and_nothing_else(flight: Flight) -> None:
    checks = [
        {"name": f"check-{status.value}", "status": status.value, "text": "said", "fix": ""}
        for status in Status
    ]
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await flight.open(browser)
        await page.route("**/api/v1/checks", lambda route: route.fulfill(json={"checks": checks}))
        await page.reload()
        listed = page.locator("#checklist")
        await expect(listed).to_contain_text("check-warn")
        await expect(listed).to_contain_text("check-fail")
        await expect(listed).not_to_contain_text("check-ok")
        await expect(listed).not_to_contain_text("check-not-applicable")


@pytest.mark.timeout(120)
@pytest.mark.parametrize("theme", ["light", "dark"])
async def test_the_page_is_accessible_by_day_and_by_night(
    flight: Flight, theme: Literal["light", "dark"]
) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        # The checker is put into the page, which the page's own policy would not let it.
        page = await flight.open(browser, color_scheme=theme, bypass_csp=True)
        await shows(page, "ready")
        await is_accessible(page)
        await page.locator("#stop").click()
        await shows(page, "estop")
        await is_accessible(page)
        # Without news, as a busy computer has it at any time: greyed, and legible.
        flight.child.send_signal(signal.SIGSTOP)
        await expect(page.locator("body")).to_have_class("stale")
        await is_accessible(page)
        flight.child.send_signal(signal.SIGCONT)


async def is_accessible(page: Page) -> None:
    found = await Axe().run(page)
    bad = [one for one in found.response["violations"] if one["impact"] in SERIOUS]
    assert not bad, [(one["id"], one["nodes"][0]["html"]) for one in bad]


@pytest.mark.timeout(180)
async def test_a_whole_flight_on_the_stub_is_watched_from_enable_to_landing(
    tmp_path: Path,
) -> None:
    port = free_port(socket.SOCK_STREAM)
    overrides = (
        "web.enabled=true",
        f"web.port={port}",
        'safety.enable_by=["web"]',
    )
    async with (
        flying_bench("ardupilot", tmp_path, *overrides) as bench,
        chromium(WITHOUT_WEBGL) as browser,
    ):
        page = await browser.new_page()
        page.set_default_timeout(40_000)
        await bench.until(lambda: "operator's page:" in bench.said, within_s=30.0)
        await page.goto(f"http://127.0.0.1:{port}/")
        await expect(page.locator("#training")).to_contain_text("SIMULATED")
        flight = bench.stub.flight
        flight.set_items(passes("ardupilot"), time.monotonic())
        await shows(page, "ready")
        await enable(page)
        assert flight.arm(time.monotonic())
        assert flight.start_mission(time.monotonic())
        await shows(page, "spraying")
        await bench.until(lambda: bench.has_opened)
        await bench.until(lambda: bench.has_flown, within_s=40.0)
        await shows(page, "armed")
        # Each screen keeps nothing of its own: one that comes now is told the same.
        second = await browser.new_page()
        second.set_default_timeout(40_000)
        await second.goto(f"http://127.0.0.1:{port}/")
        await shows(second, "armed")
        for one in (page, second):  # 16 m by 6 m
            await expect(one.locator("#numbers")).to_contain_text("Area done0.01ha")
        found = bench.judged(tmp_path / "truth")
    assert found["missed"] == 0
    assert found["volume_l"] == pytest.approx(prescribed_l(), rel=0.15)

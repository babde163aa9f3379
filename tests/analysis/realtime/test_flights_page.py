"""Flights on the operator's page in a real browser: reported by keyboard, by day and by night.

Needs Chromium (`apt-get install chromium`); without it these tests are skipped.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Literal

import pytest
import pytest_asyncio
from axe_playwright_python.async_playwright import Axe
from playwright.async_api import expect

from tests.analysis.report_flight import fly
from tests.companion.realtime.test_operators_page import (
    CHROMIUM,
    SERIOUS,
    WITHOUT_WEBGL,
    answered,
    chromium,
)
from tests.companion.web_site import Site, served, until

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.asyncio(loop_scope="module"),
    pytest.mark.timeout(300),
]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def site(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Site]:
    folder = tmp_path_factory.mktemp("flights")
    journal = fly(folder)
    host = {
        "folder": str(tmp_path_factory.mktemp("state")), "config": [], "upload_link": "",
        "journals": str(journal.parent),
    }  # fmt: skip
    async with served(host=host) as found:
        found.show(armed=False, in_air=False)
        await until(lambda: found.ask("GET", "/api/v1/flights").json["not_now"] is None)
        yield found


@pytest.mark.parametrize("theme", ["light", "dark"])
async def test_a_flight_is_reported_by_keyboard_and_the_page_is_accessible(
    site: Site, theme: Literal["light", "dark"]
) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await browser.new_page(
            viewport={"width": 360, "height": 740}, color_scheme=theme, bypass_csp=True
        )
        page.set_default_timeout(200_000)
        troubles: list[str] = []
        page.on("pageerror", lambda error: troubles.append(str(error)))
        await page.goto(f"http://127.0.0.1:{site.port}/flights/")
        await page.wait_for_function("() => 'flights' in document.body.dataset")
        async with answered(page, "flights/report"):
            await page.get_by_role("button", name="Report of flight-0001.gpkg").press("Enter")
        await expect(page.locator("#report")).to_contain_text("L applied")
        assert await page.evaluate("() => document.documentElement.scrollWidth") == 360
        found = await Axe().run(page)
        bad = [one for one in found.response["violations"] if one["impact"] in SERIOUS]
        assert not bad, [(one["id"], one["nodes"][0]["html"]) for one in bad]
        async with page.context.expect_page() as opening:
            await page.get_by_role("link", name="Open the report").press("Enter")
        report = await opening.value
        await report.get_by_role("heading", level=1).wait_for()
        for width in (1280, 390):
            await report.set_viewport_size({"width": width, "height": 800})
            assert await report.evaluate("() => document.documentElement.scrollWidth") == width
        await page.locator("#stop").press("Enter")
        await page.get_by_text("stop done").wait_for()
        assert site.orders[-1].name == "stop"
        assert not troubles

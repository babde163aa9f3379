"""The office on the operator's page in a real browser: a field loaded, drawn on, planned, uploaded.

Needs Chromium (`apt-get install chromium`); without it these tests are skipped.
"""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.async_playwright import Axe
from playwright.async_api import Page, expect

from tests.companion.realtime.test_operators_page import (
    CHROMIUM,
    SERIOUS,
    WITHOUT_WEBGL,
    answered,
    chromium,
)
from tests.companion.web_site import Site, served

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
ANYANG = Path(__file__).resolve().parents[3] / "examples" / "anyang"
FOUR_LINES = re.compile(r"^([^\n]+\n){3}[^\n]+$")
FILES = [*sorted(ANYANG.glob("prescription.*")), ANYANG / "boundary.geojson"]


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    host = {
        "folder": str(tmp_path), "config": ["--config", str(ANYANG / "config.toml")],
        "upload_link": "", "journals": "",
    }  # fmt: skip
    async with served(host=host) as found:
        found.show(armed=False, in_air=False)
        yield found


async def ready(page: Page, site: Site) -> list[str]:
    """Open the office; return where what the page asks for goes, as it grows."""
    asked: list[str] = []
    page.set_default_timeout(200_000)
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: asked.append(f"trouble://{error}"))
    await page.goto(f"http://127.0.0.1:{site.port}/office/")
    await page.wait_for_function("() => document.body.dataset.office === 'ready'")
    return asked


async def settled(page: Page) -> None:
    """Wait until the map shows what it was given last: it can be drawn on."""
    await expect(page.locator("#map")).to_have_attribute("data-settled", "")


async def load(page: Page) -> None:
    await page.locator("#pick").set_input_files(FILES)
    await expect(page.locator("#files li")).to_have_count(len(FILES))


def file_type(path: Path) -> str:
    return str(json.loads(path.read_text())["fileType"])


@pytest.mark.timeout(600)
async def test_a_field_is_loaded_checked_drawn_on_and_planned(site: Site, tmp_path: Path) -> None:
    async with chromium() as browser:
        page = await browser.new_page(viewport={"width": 1280, "height": 800})
        asked = await ready(page, site)
        await load(page)
        await page.locator("#prescription").select_option("prescription.shp")
        await page.locator("#rate_field").fill("rate")
        await page.get_by_role("button", name="Check the map").click()
        await page.get_by_text("40 zones").wait_for()
        await page.locator("#field").select_option("boundary.geojson")
        await page.get_by_role("button", name="No-spray area", exact=True).click()
        await settled(page)
        box = await page.locator("#map").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for right, down in ((-12, -12), (12, -12), (12, 12), (-12, 12)):
            await page.mouse.click(x + right, y + down)
        corners = page.locator("#corners")
        await expect(corners).to_have_value(FOUR_LINES)
        third = (await corners.input_value()).splitlines()[2]
        await settled(page)
        await page.mouse.move(x + 12, y + 12)
        await page.mouse.down()
        await page.mouse.move(x + 20, y + 20, steps=4)
        await page.mouse.up()
        await expect(corners).not_to_have_value(re.compile(re.escape(third)))
        await expect(corners).to_have_value(FOUR_LINES)
        await page.get_by_role("button", name="Save the area").click()
        await expect(page.locator("#no_spray")).to_have_value("drawn-no-spray.geojson")
        (drawn,) = (tmp_path / "office" / "given").glob("drawn-*")
        ring = json.loads(drawn.read_text())["features"][0]["geometry"]["coordinates"][0]
        assert len(ring) == 5
        assert all(114.543 < lng < 114.545 and 35.995 < lat < 35.998 for lng, lat in ring)
        await page.locator("#tank_l").fill("4")
        async with answered(page, "office/plan"):
            await page.get_by_role("button", name="Plan", exact=True).click()
        await expect(page.locator("#plan")).to_contain_text("sorties,")
        await expect(page.locator("#plan tr").nth(2)).to_be_visible()
        async with page.expect_download() as loading:
            await page.get_by_role("link", name="field.plan").click()
        download = await loading.value
        assert file_type(await download.path()) == "Plan"
        assert {urlsplit(url).netloc for url in asked} == {f"127.0.0.1:{site.port}"}
        await page.locator("#stop").focus()
        await page.keyboard.press("Enter")
        await page.get_by_text("stop done").wait_for()
        assert [order.name for order in site.orders] == ["stop"]


@pytest.mark.timeout(300)
async def test_a_trial_is_made_and_checked_in_the_browser(site: Site, tmp_path: Path) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await browser.new_page(viewport={"width": 390, "height": 844})
        await ready(page, site)
        await load(page)
        await page.locator("#field").select_option("boundary.geojson")
        await page.locator("#make-kind").select_option("spots")
        await expect(page.locator("#wind_m_s")).to_be_visible()
        await expect(page.locator("#value")).to_be_hidden()
        await expect(page.locator("#make-button")).to_have_text("Make spots")
        await page.locator("#make-kind").select_option("trial")
        await expect(page.locator("#data")).to_be_hidden()
        for name, value in (
            ("rates", "15 25"),
            ("rest_l_ha", "20"),
            ("plot_m", "15"),
            ("blocks", "2"),
        ):
            await page.locator(f"#{name}").fill(value)
        async with answered(page, "office/make"):
            await page.get_by_role("button", name="Make a trial").click()
        await expect(page.locator("#make")).to_contain_text("4 plots in 2 blocks, seed 1")
        await expect(page.locator("#prescription")).to_have_value("made-prescription.gpkg")
        async with page.expect_download() as loading:
            await page.get_by_role("link", name="Keep its plots").click()
        record = json.loads((await (await loading.value).path()).read_text())
        assert record["trial"]["rest_l_ha"] == 20
        async with answered(page, "office/check"):
            await page.get_by_role("button", name="Check the map").click()
        await expect(page.locator("#check")).to_contain_text("5 zones")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("theme", ["light", "dark"])
async def test_the_office_is_accessible_without_webgl_and_draws_by_keyboard(
    site: Site, theme: Literal["light", "dark"], tmp_path: Path
) -> None:
    async with chromium(WITHOUT_WEBGL) as browser:
        page = await browser.new_page(
            viewport={"width": 360, "height": 740}, color_scheme=theme, bypass_csp=True
        )
        await ready(page, site)
        assert await page.evaluate("() => document.documentElement.scrollWidth") == 360
        await page.locator("#draw-boundary").press("Enter")
        await page.locator("#corners").fill("47, 8\n47, 8.001\n47.0005, 8.001\n47.0005, 8")
        await page.locator("#draw-save").press("Enter")
        await expect(page.locator("#field")).to_have_value("drawn-boundary.geojson")
        assert (tmp_path / "office" / "given" / "drawn-boundary.geojson").is_file()
        found = await Axe().run(page)
        bad = [one for one in found.response["violations"] if one["impact"] in SERIOUS]
        assert not bad, [(one["id"], one["nodes"][0]["html"]) for one in bad]

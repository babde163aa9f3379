r"""Pictures of the operator's page for the documentation; needs Chromium.

    python -m tests.bench.page_pictures [--out docs/images]

A field of sixteen plots is loaded, planned and uploaded in the browser, and flown by the stub in
real time (two minutes): the page in mid-pass at 1280 and 390 pixels by day and by night, the office
with its plan, and the report. Names and sizes of the files on stdout.
"""

from __future__ import annotations

import argparse
import asyncio
import socket
import sys
import tempfile
from pathlib import Path
from typing import Literal

from PIL import Image
from playwright.async_api import Page

from tests.companion.realtime.client_bench import companion_of, vehicle_bench
from tests.companion.realtime.test_operators_page import WITHOUT_WEBGL, chromium, shows
from tests.companion.wire_peer import free_port
from tests.missions.realtime.test_page_field import (
    Box,
    Day,
    plan_and_upload,
    settings_told,
    write_maps,
)

LIGHTS: dict[str, Literal["light", "dark"]] = {"day": "light", "night": "dark"}
PLOTS, PLOT_M, FIRST_M = 4, 12.0, 9.0
SHARE_FLOWN = 0.35
COLOURS = 96


def plots() -> list[tuple[Box, float]]:
    """Return a field of plots with eight rates."""
    found = []
    for row in range(PLOTS):
        for column in range(PLOTS):
            west, south = (column - PLOTS / 2) * PLOT_M, FIRST_M + row * PLOT_M
            box = (west, south, west + PLOT_M, south + PLOT_M)
            found.append((box, 12.0 + 3.0 * ((3 * row + 5 * column) % 8)))
    return found


async def kept(page: Page, path: Path) -> None:
    """Keep a picture; it is made smaller later, as the stub flies in this process."""
    await page.screenshot(path=path)


def smaller(path: Path) -> None:
    """Write a picture anew with few colours: a third of its size."""
    with Image.open(path) as image:
        image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    sys.stdout.write(f"{path}: {path.stat().st_size / 1e3:.0f} kB\n")


async def drawn(out: Path, folder: Path) -> None:
    """Fly the field, and keep the pictures."""
    config, files = write_maps(folder, plots())
    port = free_port(socket.SOCK_STREAM)
    area_ha = (PLOTS * PLOT_M) ** 2 / 10_000.0
    # In flight the simple map is drawn: WebGL without a graphics card takes the cores of the stub.
    async with (
        vehicle_bench("ardupilot", config) as bench,
        chromium() as office,
        chromium(WITHOUT_WEBGL) as browser,
    ):
        web = (
            "web.enabled=true", f"web.port={port}", 'safety.enable_by=["web"]',
            f"web.upload_link={bench.url}",
        )  # fmt: skip
        page = await office.new_page(viewport={"width": 1280, "height": 1000})
        day = Day(bench, page, f"http://127.0.0.1:{port}/")
        day.watch()
        async with companion_of(bench, *web):
            await bench.until(lambda: "operator's page:" in bench.said, within_s=60.0)
            await day.load_and_check(files)
            await page.locator("#angle_deg").fill("0")
            await plan_and_upload(page)
            settings = await settings_told(page)
            await page.locator("#plan").scroll_into_view_if_needed()
            await page.locator("#answer").wait_for(state="hidden")
            await kept(page, out / "operators-page-plan.png")
            await page.close()
        bench.said = ""
        async with companion_of(bench, *web, *settings):
            await bench.until(lambda: "operator's page:" in bench.said, within_s=60.0)
            phone = await browser.new_page(viewport={"width": 390, "height": 844})
            day = Day(bench, phone, day.place)
            day.watch()
            await day.open()
            desk = await browser.new_page(viewport={"width": 1280, "height": 800})
            desk.set_default_timeout(120_000)
            await desk.goto(day.place)
            await desk.wait_for_function("() => 'map' in document.body.dataset")
            await day.take_off()
            await desk.wait_for_function(
                "(done) => parseFloat(document.getElementById('numbers').textContent"
                ".split('Area done')[1]) >= done",
                arg=SHARE_FLOWN * area_ha,
            )
            for light, scheme in LIGHTS.items():
                for name, one in (("1280", desk), ("390", phone)):
                    await one.emulate_media(color_scheme=scheme)
                    await one.evaluate("() => scrollTo(0, 0)")
                    await shows(one, "spraying")
                    await one.wait_for_function(
                        "() => parseFloat(document.getElementById('numbers').textContent"
                        ".split('Ground speed')[1]) >= 4.8"
                        " && document.getElementById('n-actual').textContent > '10'"
                    )
                    await kept(one, out / f"operators-page-{name}-{light}.png")
            await desk.close()
            await phone.emulate_media(color_scheme="light")
            await day.land(within_s=300.0)
            await phone.get_by_role("link", name="Report, and what is left").click()
            await phone.locator("#report .verdict").wait_for()
            await phone.wait_for_function("() => !document.body.dataset.busy")
            await kept(phone, out / "operators-page-report.png")


def main() -> int:
    """Keep the pictures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(drawn(out, Path(folder)))
    for path in sorted(out.glob("operators-page-*.png")):
        smaller(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())

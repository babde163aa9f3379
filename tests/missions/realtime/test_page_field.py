"""A whole field in the browser on the stub: from its data to the report, with a stop in between.

Needs Chromium (`apt-get install chromium`); without it this test is skipped.
"""

from __future__ import annotations

import json
import re
import shutil
import socket
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import shapely
from playwright.async_api import Page, expect
from shapely.geometry.base import BaseGeometry

from tests.companion.realtime.client_bench import (
    CLOSED_US,
    EXAMPLE,
    Bench,
    service_of,
    vehicle_bench,
)
from tests.companion.realtime.test_operators_page import (
    CHROMIUM,
    STOP_WITHIN_S,
    WITHOUT_WEBGL,
    answered,
    chromium,
    enable,
    release,
    shows,
)
from tests.companion.wire_peer import free_port
from tests.quickest import quickest
from tests.sitl.stub_bench import HOME

pytest.importorskip("mavsdk.asyncio")
pytestmark = [
    pytest.mark.sitl,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
# Two passes of 6 m over two zones; the vehicle stands south of it.
WIDTH_M, ZONE_M, FIRST_M = 12.0, 20.0, 9.0
RATES_L_HA = (15.0, 25.0)
FIELD_HA = WIDTH_M * ZONE_M * len(RATES_L_HA) / 10_000.0
# As the page shows it.
ROUNDED_HA = 0.005
PRESCRIBED_L = sum(RATES_L_HA) * WIDTH_M * ZONE_M / 10_000.0


LIMITS = (
    'version = 1\ntitle = "a label"\ntemperature_max_c = 25\ninversion = "forbidden"\n'
    "observed_max_h = 2\n"
)
Box = tuple[float, float, float, float]


def write_maps(folder: Path, zones: Iterable[tuple[Box, float]]) -> tuple[Path, list[Path]]:
    """Write a configuration, and what a browser loads: a prescription and its boundary.

    A zone is west, south, east, north in metres from the vehicle's home, and its rate.
    """
    shutil.copy(EXAMPLE / "config.toml", folder)
    config = folder / "config.toml"
    text = config.read_text().replace('"prescription.shp"', '"prescription.geojson"\nunit = "L/ha"')
    # No script runs on this stub, and no board is behind it.
    text = text.replace('kind = "servo"', 'kind = "servo"\nguard = "none-on-power-loss"')
    # A strict border would keep the outer valves shut where the position's noise is over it.
    config.write_text(text.replace('border = "inside"', 'border = "volume"'))
    rated = [(shapely.box(*box), {"rate": rate}) for box, rate in zones]
    outline = shapely.union_all([box for box, _ in rated])
    files = {"prescription": rated, "boundary": [(outline, {})]}
    for name, found in files.items():
        features = [
            {"type": "Feature", "geometry": _placed(shape), "properties": properties}
            for shape, properties in found
        ]
        text = json.dumps({"type": "FeatureCollection", "features": features})
        (folder / f"{name}.geojson").write_text(text)
    return config, [folder / f"{name}.geojson" for name in files]


def _placed(shape: BaseGeometry) -> object:
    placed = shapely.transform(shape, lambda xy: [HOME.to_geographic(*one)[::-1] for one in xy])
    return json.loads(shapely.to_geojson(placed))


def two_zones() -> list[tuple[Box, float]]:
    """Return two zones, one north of the other."""
    souths_m = [FIRST_M + k * ZONE_M for k in range(len(RATES_L_HA))]
    boxes = [(-WIDTH_M / 2, south, WIDTH_M / 2, south + ZONE_M) for south in souths_m]
    return list(zip(boxes, RATES_L_HA, strict=True))


# A sample each so many metres of ground, and as far beyond the zones on all sides.
EVERY_M = 2.0
VALUES = (2.0, 1.0)


def write_samples(path: Path) -> Path:
    """Write what was seen on the two zones, as points: the lower value where more is needed."""
    rows = ["lat,lon,vigour"]
    for east in np.arange(-WIDTH_M / 2 - EVERY_M, WIDTH_M / 2 + EVERY_M + 0.1, EVERY_M):
        for along in np.arange(-EVERY_M / 2, len(VALUES) * ZONE_M + EVERY_M, EVERY_M):
            latitude_deg, longitude_deg = HOME.to_geographic(float(east), FIRST_M + float(along))
            value = VALUES[min(max(int(along // ZONE_M), 0), len(VALUES) - 1)]
            rows.append(f"{latitude_deg:.8f},{longitude_deg:.8f},{value}")
    path.write_text("\n".join([*rows, ""]))
    return path


def corners(zones: Iterable[tuple[Box, float]]) -> str:
    """Return the corners of all zones together, as they are typed on the page."""
    west, south, east, north = shapely.union_all([shapely.box(*box) for box, _ in zones]).bounds
    ring = ((west, south), (east, south), (east, north), (west, north))
    return "\n".join("{:.8f}, {:.8f}".format(*HOME.to_geographic(*place)) for place in ring)


async def plan_and_upload(page: Page) -> None:
    """Plan what is chosen on the office's page, and put it on the vehicle."""
    plan = page.locator("#plan")
    async with answered(page, "office/plan"):
        await page.get_by_role("button", name="Plan", exact=True).click()
    # Of what a flight left, what passes cover; of a whole field, what it will treat.
    await expect(plan).to_contain_text(re.compile("% (treated|covered)"))
    async with answered(page, "office/upload"):
        await page.get_by_role("button", name="Upload field.plan to the vehicle").click()
    await expect(plan).to_contain_text("field.plan: on the vehicle, read back and the same")


async def settings_told(page: Page) -> tuple[str, ...]:
    """Return the settings by which a flight follows what the page has planned, as it tells them."""
    told = (await page.locator("#plan pre").inner_text()).splitlines()
    assert told[0].startswith("prescription.file = ")
    return tuple(line.replace(" = ", "=", 1) for line in told)


async def left_ha(page: Page) -> float:
    """Follow the link of the page to the report of its own flight; return what that left."""
    await page.get_by_role("link", name="Report, and what is left").click()
    # Until then it may show the report of an earlier flight.
    await page.wait_for_function("() => 'flights' in document.body.dataset")
    await expect(page.locator("#report .mark-text").first).to_contain_text("SIMULATED")
    await expect(page.locator("#report .verdict")).to_contain_text(" L applied")
    text = await page.get_by_text("are left.").inner_text()
    return float(text.partition("treated; ")[2].split()[0])


def is_open(bench: Bench) -> bool:
    return bool(_last(bench)) and any(pulse > CLOSED_US + 20 for pulse in _last(bench).values())


def _last(bench: Bench) -> dict[int, float]:
    """Return the newest pulse of each channel that has left the autopilot."""
    return {order.channel: order.pulse_us for order in bench.sprayer.orders}


@dataclass
class Day:
    """The vehicle, a browser's page, and what went over it."""

    bench: Bench
    page: Page
    place: str
    requests: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)

    def watch(self) -> None:
        self.page.set_default_timeout(60_000)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.troubles.append(str(error)))

    async def open(self, path: str = "", ready: str = "map") -> None:
        await self.page.goto(self.place + path)
        await self.is_ready(ready)

    async def is_ready(self, ready: str) -> None:
        await self.page.wait_for_function("(name) => name in document.body.dataset", arg=ready)

    async def load_and_check(self, files: list[Path]) -> None:
        page = self.page
        await self.open("office/", "office")
        await page.locator("#pick").set_input_files(files)
        await expect(page.locator("#files li")).to_have_count(len(files))
        await page.locator("#unit").fill("L/ha")
        await page.get_by_role("button", name="Check the map").click()
        await expect(page.locator("#check")).to_contain_text(" zones")
        await page.locator("#speed_m_s").fill("5")

    async def draw_and_make(self, samples: Path, outline: str) -> None:
        """Load data, type the corners of the boundary, and make zones within it."""
        page = self.page
        await self.open("office/", "office")
        await page.locator("#pick").set_input_files(samples)
        await expect(page.locator("#files li")).to_have_count(1)
        await page.get_by_role("button", name="Boundary", exact=True).click()
        await page.locator("#corners").fill(outline)
        await page.get_by_role("button", name="Save the area").click()
        await expect(page.locator("#field")).to_have_value("drawn-boundary.geojson")
        await page.locator("#value").fill("weeds")
        # The lower value comes first, and needs more.
        await page.locator("#rates").fill(" ".join(f"{rate:g}" for rate in RATES_L_HA[::-1]))
        made = page.locator("#make")
        async with answered(page, "office/make"):
            await page.get_by_role("button", name="Make zones").click()
        await expect(made).to_contain_text("it has no column 'weeds'")
        await page.locator("#value").fill("vigour")
        async with answered(page, "office/make"):
            await page.get_by_role("button", name="Make zones").click()
        await expect(made.locator("tr")).to_have_count(1 + len(RATES_L_HA))
        await expect(page.locator("#prescription")).to_have_value("made-prescription.gpkg")
        async with answered(page, "office/check"):
            await page.get_by_role("button", name="Check the map").click()
        await expect(page.locator("#check")).to_contain_text("made-prescription.gpkg: ")
        await page.locator("#speed_m_s").fill("5")

    async def fly_what_was_planned(self) -> None:
        """Choose the planned field: the companion comes back with it, and enables nothing."""
        page = self.page
        note = page.locator("#fly-note")
        await expect(note).to_contain_text("the configuration's own field")
        await expect(page.locator("#fly-field")).to_have_value("0001-drawn-boundary")
        await page.get_by_role("button", name="Fly this field").click()
        await expect(note).to_contain_text("Flown now: 0001-drawn-boundary", timeout=60_000)
        assert "the field is 0001-drawn-boundary, chosen on the operator's page" in self.bench.said
        assert not is_open(self.bench)
        await expect(page.locator("#plan")).to_contain_text("% treated")
        await expect(page.get_by_role("button", name="Upload field.plan")).to_be_visible()

    async def declare(self) -> None:
        """Type what label and permit want to know: before that the sprayer is not ready."""
        page = self.page
        declared = page.locator("#declared")
        await expect(declared).to_contain_text("not declared")
        await expect(page.locator("#alarms")).to_contain_text("Inversion not ruled out")
        await page.get_by_label("Temperature, °C").fill("31")
        await page.get_by_label("Inversion").select_option("no")
        await page.get_by_role("button", name="Declare").click()
        await expect(page.locator("#answer")).to_contain_text("allowed is at most 25 deg C")
        await expect(page.locator("#alarms")).to_contain_text("Temperature outside label")
        await page.get_by_label("Temperature, °C").fill("19.5")
        await page.get_by_role("button", name="Declare").click()
        await expect(page.locator("#answer")).to_contain_text("declared, and kept")
        await expect(declared).to_contain_text("19.5")
        await expect(declared).not_to_contain_text("not declared")

    async def take_off(self) -> None:
        """Enable on the page; the pilot arms and starts the mission."""
        await shows(self.page, "ready")
        await enable(self.page)
        flight = self.bench.stub.flight
        await self.bench.until(lambda: flight.arm(time.monotonic()))
        assert flight.start_mission(time.monotonic())
        await self.bench.until(lambda: is_open(self.bench))
        await shows(self.page, "spraying")
        declare = self.page.get_by_role("button", name="Declare")
        if await declare.count():  # where the flight has limits
            await expect(declare).to_be_disabled()

    async def stop(self) -> None:
        """Tap STOP in mid-pass; the valves close on the wire in time, and stay closed."""
        bench, page, tries = self.bench, self.page, count(1)

        async def closing_s() -> float:
            if next(tries) > 1:  # on a computer that had much to do
                await release(page)
                await enable(page)
            await bench.until(lambda: is_open(bench), within_s=30.0)  # it may just turn
            before, tapped_s = len(bench.sprayer.orders), time.monotonic()
            await page.locator("#stop").tap()
            await bench.until(lambda: not is_open(bench))
            closed_s = max(one.at_s for one in bench.sprayer.orders[before:])
            await shows(page, "estop")
            return closed_s - tapped_s

        assert await quickest(closing_s, within_s=STOP_WITHIN_S, tries=2) <= STOP_WITHIN_S
        stopped = len(bench.sprayer.orders)
        await self.land()
        assert all(one.pulse_us <= CLOSED_US for one in bench.sprayer.orders[stopped:])

    async def land(self, within_s: float = 90.0) -> None:
        await self.bench.until(lambda: not self.bench.stub.flight.armed, within_s=within_s)

    async def plan_the_rest(self) -> None:
        """Follow the report's link: what is left is planned on the same maps."""
        await self.page.get_by_role("link", name="Plan what is left").click()
        await self.is_ready("office")
        await expect(self.page.locator("#done")).to_have_value(re.compile("^flight-"))
        await self.page.locator("#speed_m_s").fill("5")
        await plan_and_upload(self.page)

    async def release(self) -> None:
        await self.open()
        await release(self.page)


@pytest.mark.timeout(600)
async def test_a_field_is_drawn_zoned_planned_flown_stopped_continued_and_reported(
    tmp_path: Path,
) -> None:
    config, _ = write_maps(tmp_path, two_zones())
    # The boundary is drawn on the page, and the flight map has it.
    text = config.read_text().replace('boundary = "boundary.geojson"\n', "")
    config.write_text(text + '\n[[mix]]\nname = "Wetter"\namount = 1.0\nunit = "%"\n')
    samples = write_samples(tmp_path / "samples.csv")
    port = free_port(socket.SOCK_STREAM)
    async with vehicle_bench("ardupilot", config) as bench, chromium(WITHOUT_WEBGL) as browser:
        web = (
            "web.enabled=true", f"web.port={port}", 'safety.enable_by=["web"]',
            f"web.upload_link={bench.url}",
        )  # fmt: skip
        page = await browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True)
        day = Day(bench, page, f"http://127.0.0.1:{port}/")
        day.watch()
        # The weather that was observed ages by the autopilot's clock: it must be the browser's.
        bench.stub.utc_offset_s = time.time() - time.monotonic()
        limits = tmp_path / "limits.toml"
        limits.write_text(LIMITS)
        async with service_of(
            bench, *web, "web.choose_field=true", f'limits.file="{limits}"'
        ) as ended:
            await bench.until(lambda: "operator's page:" in bench.said, within_s=60.0)
            await day.draw_and_make(samples, corners(two_zones()))
            await plan_and_upload(page)
            # What is to be poured is in the mix: one part in a hundred of what it says.
            rows = await page.locator("#plan .wide tr").all_inner_texts()
            wetter, mixed = (float(row.split()[-1]) for row in rows[-2:])
            assert wetter == pytest.approx(0.01 * mixed * 1000.0, rel=0.05)
            assert mixed > PRESCRIBED_L
            assert len(bench.stub.flight.items) >= 6
            await day.fly_what_was_planned()
            assert ended == [75]
            await day.open()
            await day.declare()
            await day.take_off()
            await day.stop()
            assert 0.4 * FIELD_HA < await left_ha(page) <= FIELD_HA + ROUNDED_HA
            await day.plan_the_rest()
            await day.release()
            await day.take_off()
            await day.land()
            assert await left_ha(page) <= 0.1 * FIELD_HA
            async with page.context.expect_page() as loading:
                await page.get_by_role("link", name="Open the report").click()
            report = await loading.value
            await report.get_by_role("heading", level=1).wait_for()
            await expect(report).to_have_title(re.compile("SIMULATED"))
            await expect(report.locator("body")).to_contain_text("declared: 19.5")
        assert {urlsplit(url).netloc for url in day.requests} == {f"127.0.0.1:{port}"}
        assert not day.troubles
    assert bench.truth.summary()["volume_l"] == pytest.approx(PRESCRIBED_L, rel=0.15)

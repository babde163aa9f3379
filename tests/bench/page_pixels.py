"""How soon the operator's page paints: `python -m tests.bench.page_pixels`; needs Chromium.

First paint, from a valve's order on the wire to the pixels that show it, and the longest task
of the page's main thread with 36 and with 40,000 zones, by the clock and in time of the processor.
A busy computer makes the first longer, not the second, and so does one without a graphics card: the
thread waits in `Commit` for the pixels, idle itself. One JSON object, in milliseconds.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from playwright.async_api import Page, async_playwright

from companion import runtime
from companion.cli.web_parts import Watched, obeying
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions
from companion.web import OperatorPage, listen
from tests.companion.realtime.test_operators_page import ARGUMENTS, CHROMIUM
from tests.companion.test_run_flight import CHANNELS, SETUP
from tests.companion.web_site import about, served
from tests.companion.wire_peer import WirePeer, free_port, over_udp

CHANGES, CLOSED_US = 12, 1000
TRACED = ["disabled-by-default-devtools.timeline", "__metadata"]
# Set by the page's own script before anything else runs in it.
NOTES = """
window.notes = {tasks: [], changes: []};
new PerformanceObserver((list) => {
  for (const one of list.getEntries()) notes.tasks.push(one.duration);
}).observe({entryTypes: ["longtask"]});
addEventListener("DOMContentLoaded", () => {
  const box = document.getElementById("state");
  new MutationObserver(() => requestAnimationFrame(() => {
    notes.changes.push([box.dataset.state, performance.timeOrigin + performance.now()]);
  })).observe(box, {attributes: true});
});
"""


async def opened(browser: Any, url: str) -> Page:
    """Return a page that shows its map."""
    page: Page = await (
        await browser.new_context(viewport={"width": 390, "height": 844})
    ).new_page()
    page.set_default_timeout(60_000)
    await page.add_init_script(NOTES)
    await page.goto(url)
    await page.wait_for_function("() => document.body.dataset.map === 'ready'")
    return page


def longest_ms(trace: bytes) -> float:
    """Return the most time of the processor that a task took on the page's main thread."""
    events = json.loads(trace)["traceEvents"]
    main = {
        (event["pid"], event["tid"])
        for event in events
        if event["name"] == "thread_name" and event["args"]["name"] == "CrRendererMain"
    }
    tasks = (
        event.get("tdur", 0)
        for event in events
        if event["name"] == "RunTask" and (event["pid"], event["tid"]) in main
    )
    return float(max(tasks, default=0)) / 1e3


async def paint_ms(page: Page) -> float:
    """Return when the page first showed anything, since its request."""
    found = await page.evaluate(
        "() => performance.getEntriesByName('first-contentful-paint')[0].startTime"
    )
    return round(float(found), 1)


async def of_valves(browser: Any, folder: Path) -> dict[str, float]:
    """Fly, open and close; return paint, and the time from an order on the wire to its pixels."""
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions(page_may_enable=True))
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    link.on_order_ack(executor.acknowledge)
    listener = listen("127.0.0.1", 0)
    url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
    shown = OperatorPage(listener, about(folder), obey=obeying(link), horizon_s=SETUP.longest_s)
    recorder = Watched(runtime.NoRecorder(), shown)
    task = asyncio.create_task(
        runtime.run(SETUP, link=link, executor=executor, recorder=recorder, sensors=[shown])
    )
    late_ms = []
    async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
        await peer.until(lambda: bool(peer.outputs), within_s=30.0)
        page = await opened(browser, url)
        for number in range(CHANGES):
            peer.place(east_m=2.0)
            await asyncio.sleep(0.7)
            opens, count = number % 2 == 0, len(peer.orders)
            state, begin_ms = ("ready", "spraying")[opens], 1e3 * time.time()
            peer.enable(opens)
            # Orders are also repeated: the first one of the other kind counts.
            moved = partial(first_order, peer, count, opens=opens)
            await peer.until(lambda moved=moved: moved() is not None)  # type: ignore[misc]
            wall_ms = 1e3 * (moved().at_s + time.time() - time.monotonic())
            handle = await page.wait_for_function(
                "([state, since]) => (notes.changes.find("
                "(one) => one[0] === state && one[1] > since) ?? [0, 0])[1]",
                arg=[state, begin_ms],
            )
            late_ms.append(float(await handle.json_value()) - wall_ms)
        first_ms = await paint_ms(page)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    return {
        "first_paint": first_ms,
        "valve_to_pixel_p50": round(float(np.median(late_ms)), 1),
        "valve_to_pixel_max": round(max(late_ms), 1),
    }


def first_order(peer: WirePeer, since: int, *, opens: bool) -> Any:
    """Return the first order since a number that opens a valve, or closes one."""
    found = (one for one in peer.orders[since:] if (one.pulse_us > CLOSED_US) == opens)
    return next(found, None)


async def of_zones(browser: Any, side: int) -> dict[str, float]:
    """Show a map of so many by so many zones; return paint and the main thread's longest task."""
    told = about()
    zones = [
        {
            "name": f"{row}-{column}",
            "rate_l_ha": 10.0 + (row * 7 + column * 3) % 30,
            "areas": [[[column, row, column + 1, row, column + 1, row + 1, column, row + 1]]],
        }
        for row in range(side)
        for column in range(side)
    ]
    ring = [0, 0, side, 0, side, side, 0, side]
    told["map"] |= {"zones": zones, "field": [[ring]], "bounds_m": [0, 0, side, side]}
    async with served(None, map=told["map"]) as site:
        await browser.start_tracing(categories=TRACED)
        begin_s = time.perf_counter()
        page = await opened(browser, f"http://127.0.0.1:{site.port}/")
        ready_s = time.perf_counter() - begin_s
        for step in range(20):
            site.show(2.0 + step)
            await asyncio.sleep(0.1)
        trace = await browser.stop_tracing()
        tasks = await page.evaluate("() => notes.tasks")
        kind = await page.evaluate("() => document.getElementById('map').dataset.kind")
        return {
            "first_paint": await paint_ms(page),
            "map_ready": round(1e3 * ready_s, 1),
            "longest_task": round(max(tasks, default=0.0), 1),
            "longest_task_processor": round(longest_ms(trace), 1),
            "is_webgl": float(kind == "webgl"),
        }


async def measured() -> dict[str, Any]:
    """Measure it all in one browser."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        with tempfile.TemporaryDirectory() as folder:
            found: dict[str, Any] = {"flight": await of_valves(browser, Path(folder))}
        for side in (6, 200):
            found[f"zones_{side * side}"] = await of_zones(browser, side)
        await browser.close()
    return found


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asyncio.run(measured()), indent=2) + "\n")

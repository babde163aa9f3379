r"""What the operator's page costs the control loop, and how soon it shows a change.

    python -m tests.bench.operators_page [--seconds 15]

The real loop, link, servo outputs and page, beside a vehicle that flies over a socket; the browsers
are a process of their own: seven that read, one slow, one that never reads, one that loads the page
anew twice a second. One JSON object on stdout, in milliseconds: a step of the loop (`step`), and
its beginning up to its orders (`ordered`), without the page, with it, and with ten browsers.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from companion import runtime
from companion.cli.web_parts import Watched, obeying
from companion.core.types import Decision
from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.servo import ServoExecutor, ServoOptions
from companion.web import OperatorPage, listen
from tests.companion.test_run_flight import CHANNELS, SETUP
from tests.companion.web_site import about
from tests.companion.wire_peer import WirePeer, free_port, over_udp

READERS = 7
LAP_S = 7.0


class Timed(runtime.ControlLoop):
    """A control loop that notes how long its steps take, and when they were."""

    took_s: list[float]
    cpu_s: list[float]
    ordered_cpu_s: list[float]
    ordered_s: list[float]
    at_s: list[float]
    begin_s = begin_cpu_s = 0.0

    def turn(self) -> Decision | None:
        begin_s = self.begin_s = time.perf_counter()
        begin_cpu_s = self.begin_cpu_s = time.thread_time()
        decision = super().turn()
        if decision is not None:
            self.cpu_s.append(time.thread_time() - begin_cpu_s)
            self.took_s.append(time.perf_counter() - begin_s)
            self.at_s.append(begin_s)
        return decision

    def _carry_out(self, decision: Decision) -> None:
        super()._carry_out(decision)
        self.ordered_cpu_s.append(time.thread_time() - self.begin_cpu_s)
        self.ordered_s.append(time.perf_counter() - self.begin_s)


class Nothing(runtime.NoRecorder):
    """A recorder that keeps nothing."""


async def measured(seconds: float, folder: Path, *, page: bool, clients: bool) -> dict[str, float]:
    """Fly for some seconds, and return how long the loop's steps took."""
    Timed.took_s, Timed.ordered_s, Timed.at_s = [], [], []
    Timed.cpu_s, Timed.ordered_cpu_s = [], []
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions(page_may_enable=True))
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    link.on_order_ack(executor.acknowledge)
    recorder: Any = Nothing()
    sensors = []
    if page:
        listener = listen("127.0.0.1", 0)
        place = listener.getsockname()[1]
        told = about(folder)
        shown = OperatorPage(listener, told, obey=obeying(link), horizon_s=SETUP.longest_s)
        recorder, sensors = Watched(recorder, shown), [shown]
    task = asyncio.create_task(
        runtime.run(SETUP, link=link, executor=executor, recorder=recorder, sensors=sensors)
    )
    browsers = None
    async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
        await peer.until(lambda: bool(peer.outputs), within_s=30.0)
        if clients:
            browsers = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "tests.bench.operators_page", "--browse", str(place)),
                stdout=asyncio.subprocess.PIPE,
            )
            assert browsers.stdout is not None
            await browsers.stdout.readline()
        peer.enable()
        for times in (
            *(Timed.took_s, Timed.ordered_s, Timed.at_s, Timed.cpu_s, Timed.ordered_cpu_s),
        ):
            times.clear()
        gc.collect()
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            peer.place(east_m=-2.0)
            await asyncio.sleep(min(LAP_S, max(until_s - time.monotonic(), 0.0)))
        if browsers is not None:
            browsers.terminate()
            await browsers.wait()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    cpu_ms, ordered_cpu_ms = 1e3 * np.array(Timed.cpu_s), 1e3 * np.array(Timed.ordered_cpu_s)
    ordered_ms = 1e3 * np.array(Timed.ordered_s)
    took_ms = 1e3 * np.array(Timed.took_s)
    apart_ms = 1e3 * np.diff(Timed.at_s)
    return {
        "steps": float(len(took_ms)),
        "step_p50_ms": float(np.percentile(took_ms, 50)),
        "step_p99_ms": float(np.percentile(took_ms, 99)),
        "ordered_p50_ms": float(np.percentile(ordered_ms, 50)),
        "ordered_p99_ms": float(np.percentile(ordered_ms, 99)),
        # Of the processor: what other programs take away is not in it.
        "step_cpu_p50_ms": float(np.percentile(cpu_ms, 50)),
        "step_cpu_p99_ms": float(np.percentile(cpu_ms, 99)),
        "ordered_cpu_p50_ms": float(np.percentile(ordered_cpu_ms, 50)),
        "ordered_cpu_p99_ms": float(np.percentile(ordered_cpu_ms, 99)),
        "step_max_ms": float(took_ms.max()),
        "apart_p99_ms": float(np.percentile(apart_ms, 99)),
    }


# ------------------------------------------------------------------------------ the browsers


async def _stream(place: int, pause_s: float) -> None:
    """Read the stream of states; slowly, or with an endless pause not at all."""
    reader, writer = await asyncio.open_connection("127.0.0.1", place, limit=4096)
    writer.write(f"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1:{place}\r\n\r\n".encode())
    data = b" "
    while data:
        data = await reader.read(4096)
        await asyncio.sleep(pause_s)


async def _reload(place: int) -> None:
    """Load all of the page, again and again."""
    names = ("", "static/page.js", "static/vendor/maplibre-gl/maplibre-gl.mjs", "api/v1/map")
    while True:
        for name in names:
            reader, writer = await asyncio.open_connection("127.0.0.1", place)
            head = f"GET /{name} HTTP/1.1\r\nHost: 127.0.0.1:{place}\r\nAccept-Encoding: gzip\r\n"
            writer.write(f"{head}Connection: close\r\n\r\n".encode())
            await reader.read()
            writer.close()
        await asyncio.sleep(0.5)


async def browse(place: int) -> None:
    """Be ten browsers until somebody ends this process."""
    os.nice(19)  # they stand for other computers: what they take is not the companion's to lose
    pauses = [0.0] * READERS + [1.0, 1e9]
    tasks = [asyncio.create_task(_stream(place, pause_s)) for pause_s in pauses]
    tasks.append(asyncio.create_task(_reload(place)))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    with contextlib.suppress(ConnectionError):
        await asyncio.gather(*tasks)


async def compare(seconds: float) -> dict[str, Any]:
    """Measure without the page, with it, and with ten browsers; in turns, twice."""
    found: dict[str, list[dict[str, float]]] = {"none": [], "page": [], "ten": []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):
            for name in found:
                values = await measured(
                    seconds, Path(folder), page=name != "none", clients=name == "ten"
                )
                found[name].append(values)
    least = {
        name: {key: round(min(one[key] for one in runs), 3) for key in runs[0]}
        for name, runs in found.items()
    }
    ratios = {
        f"{key}_ratio": round(least["ten"][f"{key}_ms"] / least["none"][f"{key}_ms"], 3)
        for key in ("step_p99", "ordered_p99", "step_cpu_p99", "ordered_cpu_p99")
    }
    return {**least, **ratios}


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--browse", type=int, default=0)
    given = parser.parse_args()
    if given.browse:
        asyncio.run(browse(given.browse))
        return 0
    runtime.ControlLoop = Timed  # type: ignore[misc]
    sys.stdout.write(json.dumps(runtime.execute(lambda: compare(given.seconds)), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

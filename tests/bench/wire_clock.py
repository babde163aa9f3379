"""P1's whole field over the wire on a clock of its own: exact times on however busy a computer.

    python -m tests.bench.wire_clock [--autopilot px4] [--board free-running] [--seed 1]
                                     [--flights 3] [--as-measured] [--drift-ppm -10000]

The whole companion (link, core, executor) and the stub, byte by byte as `tests.bench.wire` has
them, but in one process whose event loop jumps to whatever is due next: nothing is late, computing
takes no time, and a frame takes 0.5 ms. A flight takes about a minute.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from companion.cli.run import build_executor, component_options
from companion.config import load
from companion.core.setup import Setup
from companion.link.vehicle_link import VehicleLink
from companion.ports import PlanExecutor, Recorder
from companion.runtime import run
from missions.maps.compiling import compiled_setup
from sitl.serve import ServeOptions, _Run
from sitl.stub.protocol import Channel
from tests.bench.wire import MEAN_ABS_MAX_M, RTK, WORST_MAX_M, example
from tests.unguarded import unguarded
from tests.virtual_time import START_S, WIRE_S, Delivery, JumpingLoop, WireLink

_TICK_S = 0.02
# The clock moves at each wait by this at least.
_LEAST_S = 1e-4


# Gets the link and the outputs of a flight before it begins.
Wired = Callable[[VehicleLink, PlanExecutor], None]

# How long, at a time, the vehicle and the wire stand still.
Holds = Callable[[float], float]


def _never(_at_s: float) -> float:
    return 0.0


async def _vehicle(stub: _Run, link: WireLink, held_s: Holds) -> None:
    """Be the vehicle until its mission is flown."""
    loop = asyncio.get_running_loop()
    # By name at each arrival: a test may have put something in its place.
    delivery = Delivery(lambda data: link.arrive(data))

    def send(data: bytes) -> None:
        delivery.send(data, wait_s=held_s(loop.time() + WIRE_S))

    channel: Channel = stub.autopilot.attach("wire", send)

    def deliver(data: bytes) -> None:
        wait_s = held_s(loop.time())
        if wait_s > _LEAST_S:
            loop.call_later(wait_s, deliver, data)
        else:
            stub.autopilot.receive(channel, data, loop.time())

    link.deliver = deliver  # type: ignore[method-assign]
    while not stub._done.is_set():
        now_s = loop.time()
        stub.autopilot.tick(now_s)
        stub.tick(now_s)
        due_s = min(max(stub.autopilot.next_due_s(), now_s), now_s + _TICK_S)
        await asyncio.sleep(max(due_s + held_s(due_s) - now_s, _LEAST_S))


async def _fly(
    config_file: Path,
    stub: _Run,
    recorder: Recorder | None,
    held_s: Holds,
    *,
    setup: Setup | None,
    wired: Wired | None,
    duration_s: float | None,
) -> str | None:
    """Fly the stub's mission with the companion; return what was the matter with the outputs."""
    loop = asyncio.get_running_loop()
    config = load(config_file)
    link = WireLink(config.link.url, component_options(config), clock=loop.time)
    executor = unguarded(build_executor(config, link))
    if wired is not None:
        wired(link, executor)
    vehicle = asyncio.create_task(_vehicle(stub, link, held_s))
    await asyncio.sleep(0.1)
    companion = asyncio.create_task(
        run(
            compiled_setup(config) if setup is None else setup,
            link=link,
            executor=executor,
            recorder=recorder,
            duration_s=duration_s,
            clock=loop.time,
            boot_clock=loop.time,
        )
    )
    await asyncio.wait({vehicle, companion}, return_when=asyncio.FIRST_COMPLETED)
    fault = executor.fault
    for task in (vehicle, companion):
        if task.done():
            task.result()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    return fault


def fly(
    config: Path,
    options: ServeOptions,
    *,
    recorder: Recorder | None = None,
    held_s: Holds = _never,
    setup: Setup | None = None,
    wired: Wired | None = None,
    duration_s: float | None = None,
    start_s: float = START_S,
) -> tuple[dict[str, Any], str | None]:
    """Fly a mission; return what the stub says, and the fault of the outputs at the end.

    `held_s` gives for how long the vehicle and the wire stand still at a time since the start.
    `setup` is flown instead of the configuration's own, `wired` gets link and outputs before the
    flight, `duration_s` ends the companion before its landing. Begun at another `start_s` it is
    another flight, as if by another seed: whether a message is due at one tick of the stub or at
    the next may be a matter of the last bit.
    """
    stub = _Run(options, lambda _: None, start_s=start_s)
    loop = JumpingLoop(start_s)
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        fault = runner.run(
            _fly(
                config,
                stub,
                recorder,
                lambda at_s: held_s(at_s - start_s),
                setup=setup,
                wired=wired,
                duration_s=duration_s,
            )
        )
    return stub.result(cancelled=False), fault


def whole_field(
    autopilot: str,
    board: str,
    seed: int,
    *,
    is_rtk: bool = True,
    dither_us: int = 0,
    drift_ppm: float = 0.0,
) -> dict[str, Any]:
    """Fly the example's field once and return what counts of it."""
    with tempfile.TemporaryDirectory(prefix="wire-") as name:
        folder = Path(name)
        scenario = folder / "scenario.toml"
        clock = f"[clock]\ndrift_ppm = {drift_ppm!r}\n" if drift_ppm else ""
        scenario.write_text((RTK if is_rtk else "") + clock, encoding="utf-8")
        config = example(folder / "anyang", autopilot=autopilot, port=14550, dither_us=dither_us)
        options = ServeOptions(
            autopilot=autopilot,
            board="restarting" if board == "restarting" else "free-running",
            field_config=config,
            scenario=scenario,
            seed=seed,
            out=folder / "truth",
        )
        found, fault = fly(config, options)
    metrics = found.get("metrics", {})
    lag = metrics.get("lag_distance_m", {})
    return {
        "autopilot": autopilot,
        "board": board,
        "seed": seed,
        "rtk": is_rtk,
        "dither_us": dither_us,
        "drift_ppm": drift_ppm,
        "state": found["state"],
        "orders": found["orders"],
        "lag_distance_m": lag,
        "missed": metrics.get("missed"),
        "off_target_ml": metrics.get("off_target_ml"),
        "fault": fault,
        "met": bool(lag and lag["mean_abs"] <= MEAN_ABS_MAX_M and lag["max_abs"] <= WORST_MAX_M),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the flights; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.wire_clock",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--autopilot", choices=("ardupilot", "px4"), default="ardupilot")
    parser.add_argument("--board", choices=("restarting", "free-running"), default="restarting")
    parser.add_argument("--seed", type=int, default=1, help="the first of the seeds")
    parser.add_argument("--flights", type=int, default=1)
    parser.add_argument("--dither-us", type=int, default=0)
    parser.add_argument(
        "--as-measured", action="store_true", help="PX4's position as measured: 0.1 m of bias"
    )
    parser.add_argument("--drift-ppm", type=float, default=0.0, help="the vehicle's clock is fast")
    given = parser.parse_args(arguments)
    flights = [
        whole_field(
            given.autopilot,
            given.board,
            seed,
            is_rtk=not given.as_measured,
            dither_us=given.dither_us,
            drift_ppm=given.drift_ppm,
        )
        for seed in range(given.seed, given.seed + given.flights)
    ]
    sys.stdout.write(json.dumps({"flights": flights}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

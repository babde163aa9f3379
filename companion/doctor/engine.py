"""Is this computer quick enough to make the valves' edges: the engine tests itself, on no lines."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace

from companion.doctor.check import Check, fail, not_applicable, ok, warn
from companion.errors import ActuatorError
from companion.output.engine.selftest import SelfTest
from companion.output.engine.setup import WAKE_LATE_MAX_S, EngineSetup
from companion.output.gpio import GpioExecutor

NAME = "gpio-latency"
# What edges are to keep to: 6 mm at 6 m/s.
WANTED_S = 0.001
_FIX = "LimitRTPRIO=50 in the service or rtprio in /etc/security/limits.conf, or less to do"


def read_engine(setup: EngineSetup) -> SelfTest:
    """Return the self-test of a valve engine that is started for it, with outputs in memory."""
    executor = GpioExecutor(replace(setup, backend="memory", wake_late_max_s=WAKE_LATE_MAX_S))
    try:
        asyncio.run(_start_and_stop(executor))
    except ActuatorError as error:
        return SelfTest(fault=str(error))
    return executor.self_test or SelfTest(fault="no self-test")


async def _start_and_stop(executor: GpioExecutor) -> None:
    try:
        await executor.start()
    finally:
        await executor.stop()


def engine_checks(found: SelfTest | None) -> Iterator[Check]:
    """Yield the check of the engine's latency; None where no engine is used."""
    if found is None:
        yield not_applicable(NAME, "no GPIO lines are used")
        return
    late = f"wake-ups late by {found.median_late_s * 1e3:.1f} ms (median), "
    late += f"{found.p99_late_s * 1e3:.1f} ms (p99)"
    if found.fault:
        yield fail(NAME, f"the valve engine {found.fault}", _FIX)
    elif found.p99_late_s <= WANTED_S:
        yield ok(NAME, late)
    else:
        yield warn(NAME, late, _FIX)

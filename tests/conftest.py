"""What holds for every test: nothing is left running, and two runs of one commit agree."""

from __future__ import annotations

import asyncio
import gc
import inspect
import itertools
import multiprocessing.resource_tracker
import os
import signal
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import pytest
import pytest_asyncio
from hypothesis import HealthCheck, settings

LoopFactory = Callable[[], asyncio.AbstractEventLoop]
SAMPLES_VARIABLE = "VRSPRAY_SAMPLES"
GRACE_S = 2.0

# Repeatable: the same examples at every run, and no verdict that depends on how busy the machine
# is. `HYPOTHESIS_PROFILE=thorough` draws new and many more ones.
_NOT_TIMED = [HealthCheck.too_slow]
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=_NOT_TIMED
)
settings.register_profile(
    "thorough", max_examples=5000, deadline=None, suppress_health_check=_NOT_TIMED
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


# Children say there what they leave open. Their own warnings stay as they are in use.
_LEFT_OPEN = tempfile.TemporaryDirectory(prefix="vrspray-left-open-")


# Python's own 700 finds nothing that the collection after each module does not, and takes a
# twentieth of all the time.
OBJECTS_BEFORE_COLLECTION = 100_000


_FAIR_TIME = pytest.StashKey["FairTime"]()


def pytest_configure(config: pytest.Config) -> None:
    """Have the Python processes that tests start tell of what they leave open, and one clock."""
    # Before what is tested is imported. Not in a process that has others test, nor beside real
    # firmwares, which go by the computer's clock. Only here: this file serves projects of one test.
    is_real = "not firmware" not in config.getoption("markexpr")
    has_clock = Path(__file__).with_name("fair_time.py").exists()
    if config.getoption("dist", "no") == "no" and has_clock and not is_real:
        from tests.fair_time import FairTime

        config.stash[_FAIR_TIME] = FairTime()
    gc.set_threshold(OBJECTS_BEFORE_COLLECTION, 20, 20)
    os.environ["VRSPRAY_LEFT_OPEN"] = _LEFT_OPEN.name
    ours = str(Path(__file__).parent / "child_python")
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [ours, *given]))
    # Theirs would speak of asyncio's slow steps on stderr.
    os.environ.pop("PYTHONDEVMODE", None)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the places where children tell, and what tells them the time."""
    _LEFT_OPEN.cleanup()
    if (fair_time := config.stash.get(_FAIR_TIME, None)) is not None:
        fair_time.close()


def pytest_asyncio_loop_factories(item: pytest.Item) -> Mapping[str, LoopFactory]:
    """Have tests that are marked so run on virtual time, all others on that of the computer."""
    if item.get_closest_marker("virtual_time") is not None:
        # Only here: this file serves projects of one test as well.
        from tests.virtual_time import JumpingLoop

        return {"virtual": JumpingLoop}
    return {"real": asyncio.new_event_loop}


# Modules that take longest begin first, the longest of all before: the other processes have enough
# to do meanwhile. Those in real time, and then those that compute.
LONGEST = (
    "test_tutorial.py",
    "test_page_field.py",
    "test_mission_chain.py",
    "test_operators_page.py",
    "test_upload.py",
    "test_wire_flight.py",
    "test_doctor_click.py",
    "test_clients_mavsdk.py",
    "test_ground.py",
    "test_office_page.py",
    "test_fault_campaign.py",
    "test_run_process.py",
    "test_golden.py",
    "test_campaign.py",
    "test_sample_flight.py",
    "test_howto.py",
    "test_web_office.py",
    "test_missions_outlines.py",
    "test_liquid_wire.py",
    "test_wheel.py",
    "test_simulated_records.py",
    "test_cli_map_convert.py",
    "test_own_method.py",
    "test_bench.py",
    "test_web_flights.py",
    "test_plan_lines.py",
    "test_sitl_fly.py",
    "test_demo.py",
    "test_run_lines.py",
    "test_make_zones.py",
    "test_report_figures.py",
    "test_make_flown.py",
    "test_valve_calibration.py",
    "test_commands.py",
    "test_px4_flight.py",
    "test_missions_plan.py",
    "test_missions_ends_over.py",
    "test_doctor_watchdogs.py",
)
FIRST = {name: place for place, name in enumerate(LONGEST)}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the modules that take longest first, and look for tasks wherever a loop turns."""
    items.sort(key=lambda item: FIRST.get(item.path.name, len(FIRST)))
    for item in items:
        if isinstance(item, pytest.Function) and _has_loop(item):
            # Behind what a module has once: a page for all its tests is left by none of them.
            place = item.fixturenames.index("no_thread_left_behind") + 1
            item.fixturenames.insert(place, "no_task_left_behind")


def _has_loop(item: pytest.Function) -> bool:
    """Whether a test or a fixture of it is async; a loop for each other test takes 10 s in all."""
    fixtures = itertools.chain(*item._fixtureinfo.name2fixturedefs.values())
    return pytest_asyncio.is_async_test(item) or any(_is_async(one.func) for one in fixtures)


def _is_async(function: Callable[..., object]) -> bool:
    return inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)


@pytest.fixture
def samples() -> Path:
    """Return the folder of real prescription maps, or skip where there is none."""
    folder = os.environ.get(SAMPLES_VARIABLE)
    if not folder:
        pytest.skip(f"{SAMPLES_VARIABLE} is not set")
    return Path(folder)


def _children() -> set[int]:
    """Return the ids of our child processes, dead ones that nobody waited for included."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return set()  # the usual case, and the quick one
    children: set[int] = set()
    for one in Path("/proc/self/task").glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            children.update(map(int, one.read_text().split()))
    # Python's own helper of shared memory lives as long as we do.
    tracker = multiprocessing.resource_tracker._resource_tracker._pid  # type: ignore[attr-defined]
    return children - {tracker}


@pytest.fixture(autouse=True)
def no_process_left_behind() -> Iterator[None]:
    """Fail a test that leaves a child process, and end the child."""
    before = _children()
    yield
    left = _children() - before
    for pid in left:
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    assert not left, f"child processes left behind: {sorted(left)}"


@pytest.fixture(autouse=True)
def nothing_left_open_by_children(no_process_left_behind: None) -> Iterator[None]:
    """Fail a test whose child process left a file, a socket or a database to the collector."""
    yield
    told = []
    for note in Path(_LEFT_OPEN.name).iterdir():
        told.append(note.read_text())
        note.unlink()
    assert not told, "".join(told)


@pytest.fixture(autouse=True, scope="module")
def nothing_left_open() -> Iterator[None]:
    """Collect after every module: what it left open is told of there, and not by chance elsewhere.

    What lives on by then is not looked at again, which makes the next collection a short one.
    """
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def no_thread_left_behind(no_process_left_behind: None) -> Iterator[None]:
    """Fail a test that leaves a thread running; one that is just ending is waited for."""
    before = set(threading.enumerate())
    yield
    left = set(threading.enumerate()) - before
    for thread in left:
        thread.join(GRACE_S)
    running = [thread.name for thread in left if thread.is_alive()]
    assert not running, f"threads left running: {running}"


@pytest.fixture
async def no_task_left_behind(no_thread_left_behind: None) -> AsyncIterator[None]:
    """Fail a test that leaves a task running; one that was just cancelled may end."""
    before = asyncio.all_tasks()
    yield
    left = asyncio.all_tasks() - before - {asyncio.current_task()}
    for task in left:
        task.cancel()
    if left:
        await asyncio.wait(left, timeout=GRACE_S)
    assert not left, f"tasks left running: {[task.get_coro() for task in left]}"


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Fly what flies in real time by a clock that stands while the computer holds it up."""
    found = item.config.stash.get(_FAIR_TIME, None)
    if found is None or "realtime" not in item.path.parts or item.get_closest_marker("browser"):
        return None
    from tests import fair_time

    fair_time.fly(found, item, nextitem)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many golden tests did not run for want of the real maps."""
    skipped = terminalreporter.stats.get("skipped", [])
    golden = sum(SAMPLES_VARIABLE in str(report.longrepr) for report in skipped)
    if golden:
        terminalreporter.section("golden tests")
        terminalreporter.line(
            f"{golden} golden tests skipped: {SAMPLES_VARIABLE} names no folder of real maps"
        )

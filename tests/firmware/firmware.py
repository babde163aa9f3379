"""The real firmwares of VRSPRAY_FIRMWARE as processes, one at a time, ended whatever happens."""

from __future__ import annotations

import ctypes
import fcntl
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.firmware.station import NoAnswerError, Station

ROOT = Path(__file__).parents[2]
WATCHDOG = ROOT / "deploy" / "ardupilot" / "vrspray_watchdog.lua"
# Their ports are fixed: 5760 and 14550 of ArduCopter, 14540 and 14550 of PX4.
LOCK = Path(tempfile.gettempdir()) / "vrspray-firmware.lock"
TCP_PORT, UDP_PORTS = 5760, (14540, 14550)
# Every vehicle sends a heartbeat a second.
STRANGERS_WITHIN_S, QUIET_WITHIN_S = 1.1, 60.0
TERMINATED_WITHIN_S = 10.0
LISTENS_WITHIN_S = 20.0
_PR_SET_PDEATHSIG = 1


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Hold the lock of the ports: flights of other runs wait, and we for strangers."""
    with LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        end_s = time.monotonic() + QUIET_WITHIN_S
        while taken := _taken_port():
            if time.monotonic() > end_s:
                raise NoAnswerError(f"{taken}: end what uses it")
        yield


def _taken_port() -> str | None:
    """Return the port that somebody uses: a vehicle that sends to it would be taken for ours."""
    ears = []
    try:
        for port in UDP_PORTS:
            ears.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            ears[-1].bind(("127.0.0.1", port))
        with socket.socket() as knock:
            if knock.connect_ex(("127.0.0.1", TCP_PORT)) == 0:
                return f"port {TCP_PORT} is listened to"
        heard, _, _ = select.select(ears, [], [], STRANGERS_WITHIN_S)
        return f"port {heard[0].getsockname()[1]} is sent to" if heard else None
    except OSError as error:
        return f"port {UDP_PORTS[len(ears) - 1]} is taken ({error.strerror})"
    finally:
        for ear in ears:
            ear.close()


@contextmanager
def process(
    command: Sequence[str | Path],
    log: Path,
    *,
    with_signal: int = signal.SIGTERM,
    within: Path | None = None,
    **variables: str,
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command, its output in `log`; end it, and what it has started, at the end."""
    with log.open("wb") as out:
        started = subprocess.Popen(
            [str(part) for part in command],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            cwd=within,
            env={**os.environ, **variables},
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )
    try:
        yield started
    finally:
        end(started, with_signal)


def end(started: subprocess.Popen[bytes], with_signal: int = signal.SIGTERM) -> int:
    """End a process and what it has started; return its exit code."""
    if started.poll() is None:
        started.send_signal(with_signal)
        try:
            started.wait(TERMINATED_WITHIN_S)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
    return started.wait()


@contextmanager
def companion(
    folder: Path, *options: str, name: str = "companion.txt", within: Path | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run `vrspray run` as it would fly; what it says is in `name`."""
    command = (sys.executable, "-m", "companion", "run", *options)
    with process(command, folder / name, within=within) as started:
        yield started


def vrspray(
    *command: str, within_s: float = 120.0, within: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command of the program to its end."""
    return subprocess.run(
        [sys.executable, "-m", "companion", *command],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=within_s,
        cwd=within,
        check=False,
    )


@contextmanager
def arducopter(
    firmware: Path,
    folder: Path,
    home: str,
    *,
    parameters: dict[str, float] | None = None,
    has_watchdog: bool = True,
) -> Iterator[Station]:
    """ArduCopter with the watchdog script, and a station on its first port; not yet ready."""
    (folder / "scripts").mkdir(parents=True, exist_ok=True)
    settings = {"AUTO_OPTIONS": 3.0, **(parameters or {})}
    if has_watchdog:
        (folder / "scripts" / WATCHDOG.name).write_bytes(WATCHDOG.read_bytes())
    more = folder / "test.parm"
    more.write_text("".join(f"{name} {value:g}\n" for name, value in settings.items()))
    command = (firmware / "arducopter.sh", folder, home)
    with process(command, folder / "arducopter.txt", PARAMS=str(more)) as vehicle:
        station = _connected(vehicle, lambda: Station("tcp", 5760))
        try:
            yield station
        finally:
            station.close()


@contextmanager
def px4(
    firmware: Path, folder: Path, latitude: str, longitude: str, height: str
) -> Iterator[Station]:
    """PX4's SIH quadrotor, and a station on its ground station's port; not yet ready."""
    folder.mkdir(parents=True, exist_ok=True)
    station = Station("udp", 14550)
    try:
        started = with_links(firmware, folder / "firmware")
        command = (started / "px4.sh", folder, latitude, longitude, height)
        with process(command, folder / "px4.txt"):
            yield station
    finally:
        station.close()


def with_links(firmware: Path, copy: Path) -> Path:
    """Return where PX4 starts: its start script calls `px4-...`, links to `px4`.

    A copy of the folder that has lost them is given them again, in a copy of its own.
    """
    if os.access(firmware / "px4" / "bin" / "px4-param", os.X_OK):
        return firmware
    shutil.copytree(firmware / "px4", copy / "px4", copy_function=shutil.copy)
    shutil.copy(firmware / "px4.sh", copy)
    for folder, _, _ in os.walk(copy):
        Path(folder).chmod(0o755)
    for lost in copy.glob("px4/*/px4-*"):
        if lost.read_bytes() == b"px4":
            lost.unlink()
            lost.symlink_to("px4")
    return copy


def _connected(vehicle: subprocess.Popen[bytes], opened: Callable[[], Station]) -> Station:
    """Connect as soon as the firmware listens; nothing tells of that but trying."""
    end_s = time.monotonic() + LISTENS_WITHIN_S
    while True:
        try:
            return opened()
        except ConnectionRefusedError:
            if vehicle.poll() is not None or time.monotonic() > end_s:
                raise NoAnswerError(
                    f"the firmware does not listen (ended: {vehicle.poll()})"
                ) from None
            time.sleep(0.05)

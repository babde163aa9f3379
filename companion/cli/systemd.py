"""The systemd of this computer: where units lie, what `systemctl` says, and what a run tells it.

The protocol is a datagram of `KEY=VALUE` lines to the socket in NOTIFY_SOCKET (sd_notify(3)). In a
container, where there is no systemd, the same steps touch the file in VRSPRAY_ALIVE_FILE, whose age
the image's health check looks at.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Self

from companion.atomic_write import write_atomically
from companion.errors import VrsprayError

NAME = "vrspray.service"
_PROPERTIES = "LoadState,UnitFileState,ActiveState,SubState,Result,NRestarts,WatchdogUSec"
_WAIT_S = 30.0


class ServiceError(VrsprayError):
    """The service cannot be installed or removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a call of `systemctl` came to; code None where there is no systemd to ask."""

    code: int | None
    text: str


def unit_path(*, is_user: bool) -> Path:
    """Return where the unit lies."""
    if not is_user:
        return Path("/etc/systemd/system") / NAME
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "systemd" / "user" / NAME


def systemctl(*arguments: str, is_user: bool) -> Answer:
    """Call `systemctl` and return what it says; never raises."""
    program = shutil.which("systemctl")
    if program is None:
        return Answer(code=None, text="there is no systemctl")
    words = [program, *(["--user"] if is_user else []), *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_WAIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Answer(code=None, text=str(error))
    text = " ".join((done.stdout if done.returncode == 0 else done.stderr or done.stdout).split())
    return Answer(code=done.returncode, text=text)


def properties(*, is_user: bool) -> dict[str, str] | None:
    """Return what systemd knows of the unit; None where there is no systemd to ask."""
    found = systemctl("show", NAME, f"--property={_PROPERTIES}", is_user=is_user)
    if found.code != 0:
        return None
    pairs = (word.partition("=") for word in found.text.split())
    return {key: value for key, _, value in pairs}


def read_unit(path: Path) -> str | None:
    """Return the unit's text; None where there is none."""
    try:
        return path.read_text()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ServiceError(f"{path}: cannot be read; {_advice(error)}") from error


def write_unit(path: Path, text: str) -> None:
    """Write the unit in one piece; one that somebody else wrote is not replaced."""
    refuse_foreign(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode(), mode=0o644)
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written; {_advice(error)}") from error


def remove_unit(path: Path) -> None:
    """Remove the unit, if it is ours."""
    refuse_foreign(path)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ServiceError(f"{path}: cannot be removed; {_advice(error)}") from error


def refuse_foreign(path: Path) -> None:
    """Raise a `ServiceError` where the file is not one of ours."""
    text = read_unit(path)
    if text is not None and not is_ours(text):
        raise ServiceError(f"{path}: not written by vrspray service install; move it away first")


def typed() -> str:
    """Return how root calls this very program: by its full path, with what was typed."""
    program = Path(shutil.which(sys.argv[0]) or sys.argv[0]).absolute()
    is_module = program.name == "__main__.py"
    start = [sys.executable, "-m", "companion"] if is_module else [str(program)]
    return shlex.join([*start, *sys.argv[1:]])


def _advice(error: Exception) -> str:
    if isinstance(error, PermissionError):
        # Root's PATH has neither virtual environments nor what pipx installs.
        return f"use sudo {typed()}, or --user for a service of your own"
    return str(getattr(error, "strerror", None) or error).lower()


# The text of the systemd unit, from a template and what is particular to this computer. Pure.

MARK = "# Written by `vrspray service install`"
# Below the valve engine (50), above everything that is not real time.
PRIORITY = 20
_PLAIN = re.compile(r"[A-Za-z0-9_./:=@+,-]+")

_SANDBOX = """\
ProtectSystem=strict
ProtectHome=read-only
ReadWritePaths={writable}
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectProc=invisible
RestrictNamespaces=yes
RestrictSUIDSGID=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
LockPersonality=yes
SystemCallArchitectures=native
{capabilities}
UMask=0027
# Devices stay open: a serial adapter that is plugged in later has to be found."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """What the template leaves open; paths are absolute.

    `closer` are the arguments of the independent closer, empty where no valve hangs on this
    computer's lines; `is_guarded` where some hang on the autopilot. `account` and `groups` are for
    a system's unit only.
    """

    python: str
    config: str
    writable: tuple[str, ...]
    closer: tuple[str, ...] = ()
    is_user: bool = False
    account: str = ""
    groups: tuple[str, ...] = ()
    is_realtime: bool = False
    is_guarded: bool = True
    writes_sysfs: bool = False

    def text(self) -> str:
        """Return the unit's file."""
        template = resources.files("companion.cli").joinpath("vrspray.service").read_text()
        filled = template.format(
            start=command(self.python, "-P", "-m", "companion", "run", "--config", self.config),
            closer=self._closer(),
            ending=self._ending(),
            account="" if self.is_user else self._account(),
            realtime=self._realtime(),
            sandbox="" if self.is_user else self._sandbox(),
            target="default.target" if self.is_user else "multi-user.target",
        )
        return re.sub(r"\n{2,}(?!\[)", "\n", filled)

    def _closer(self) -> str:
        if not self.closer:
            return "# No valve hangs on this computer's lines: there is nothing to close after it."
        close = command(self.python, "-P", "-m", "companion.output.engine.closer", *self.closer)
        return (
            "# After every end, crash and watchdog included: lines to their safe levels.\n"
            f"ExecStopPost={close}"
        )

    def _ending(self) -> str:
        if not self.is_guarded:
            return (
                "# The companion stops its valve engine by itself; what is left of it is killed.\n"
                "KillMode=mixed"
            )
        return (
            "# After a crash the guardian, at SIGTERM, closes the servo outputs for 2 s more.\n"
            "KillMode=control-group"
        )

    def _account(self) -> str:
        lines = [f"User={self.account}"] if self.account else []
        lines.append("# Short of memory, Linux ends other programs first, and the guardian last.")
        lines.append("OOMScoreAdjust=-500")
        if self.groups:
            lines.append(f"SupplementaryGroups={' '.join(self.groups)}")
        return "\n".join(lines)

    def _realtime(self) -> str:
        if self.is_user or not self.is_realtime:
            return ""
        return f"CPUSchedulingPolicy=fifo\nCPUSchedulingPriority={PRIORITY}"

    def _sandbox(self) -> str:
        # Root without its capabilities could not write to a folder of another user.
        is_root = self.account in ("", "root")
        # Hardware PWM is written in /sys, which this would make read-only.
        sandbox = (
            _SANDBOX.replace("ProtectKernelTunables=yes\n", "") if self.writes_sysfs else _SANDBOX
        )
        return sandbox.format(
            writable=" ".join(quoted(path) for path in self.writable),
            capabilities="# Better run as a user: --run-as USER"
            if is_root
            else "CapabilityBoundingSet=",
        )


def command(*words: str) -> str:
    """Return a command line as systemd takes it apart again.

    >>> command("/opt/my python", "-c", "100 %")
    '"/opt/my python" -c "100 %%"'
    """
    return " ".join(quoted(word).replace("$", "$$") for word in words)


def quoted(word: str) -> str:
    """Return a word that systemd reads as one, with nothing in it replaced.

    >>> quoted("/srv/a field"), quoted("/etc/vrspray")
    ('"/srv/a field"', '/etc/vrspray')
    """
    if any(not letter.isprintable() for letter in word):
        raise ValueError(f"a control character in {word!r}")
    if _PLAIN.fullmatch(word):
        return word
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"'


def is_ours(text: str) -> bool:
    """Return whether a unit was written by this program, so that it may be replaced."""
    return text.startswith(MARK)


def watchdog_is_on(lines: Sequence[str]) -> bool:
    """Return whether a unit has a watchdog.

    >>> watchdog_is_on(["Type=notify", "WatchdogSec=2"])
    True
    """
    return any(re.fullmatch(r"WatchdogSec=\s*(?!0*\s*$)\S.*", line) for line in lines)


# ----------------------------------------------------------------------------------- a run tells it

# A journal takes up to 30 s to close; the valves are closed by then, and no step follows.
CLOSING_MAX_S = 35.0
# The file of a container is touched half as often as this says.
ALIVE_S = 2.0


class Notifier:
    """Sends READY=1 at the first step, and WATCHDOG=1 at most twice in the watchdog's time.

    It has no timer: a loop that stands still is silent, and systemd ends it.
    """

    def __init__(
        self,
        send: Callable[[bytes], None] | None = None,
        *,
        watchdog_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._send = send
        self._pause_s = None if watchdog_s is None else 0.5 * watchdog_s
        self._clock = clock
        self._fed_s: float | None = None

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str], *, pid: int) -> Notifier:
        """Return what the environment asks for, and take it out: it is not for our children."""
        address = environment.pop("NOTIFY_SOCKET", "")
        watchdog_us = environment.pop("WATCHDOG_USEC", "")
        meant = environment.pop("WATCHDOG_PID", str(pid))
        alive = environment.pop("VRSPRAY_ALIVE_FILE", "")
        if not address.startswith(("/", "@")):
            return cls(_toucher(Path(alive)), watchdog_s=ALIVE_S) if alive else cls()
        is_watched = watchdog_us.isdecimal() and int(watchdog_us) > 0 and meant == str(pid)
        return cls(
            _sender(address.replace("@", "\0", 1) if address[0] == "@" else address),
            watchdog_s=int(watchdog_us) / 1e6 if is_watched else None,
        )

    def stepped(self) -> None:
        """Take that the control loop has made a step."""
        if self._send is None:
            return
        now_s = self._clock()
        if self._fed_s is None:
            self._fed_s = now_s
            self._send(b"READY=1\nWATCHDOG=1")
        elif self._pause_s is not None and now_s - self._fed_s >= self._pause_s:
            self._fed_s = now_s
            self._send(b"WATCHDOG=1")

    def __enter__(self) -> Self:
        """Begin; nothing is sent before the first step."""
        return self

    def __exit__(self, *_: object) -> None:
        """Take that the loop has ended and all is closed: the journal may take its time."""
        if self._send is not None:
            self._send(f"STOPPING=1\nWATCHDOG_USEC={round(CLOSING_MAX_S * 1e6)}".encode())


def _toucher(file: Path) -> Callable[[bytes], None]:
    def send(_: bytes) -> None:
        with suppress(OSError):
            file.touch()

    return send


def _sender(address: str) -> Callable[[bytes], None]:
    def send(message: bytes) -> None:
        # What cannot be sent now is missed by systemd, which is what it is for.
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
        ):
            channel.setblocking(False)
            channel.sendto(message, address)

    return send

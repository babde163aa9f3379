"""`vrspray service`: run as a service of systemd, with its watchdog."""

from __future__ import annotations

import getpass
import grp
import os
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, new_app
from companion.cli.output_parts import (
    engine_setup,
    motor_closer_arguments,
    pwm_drives,
    servo_options,
)
from companion.cli.systemd import (
    NAME,
    ServiceError,
    Unit,
    properties,
    read_unit,
    refuse_foreign,
    remove_unit,
    systemctl,
    unit_path,
    write_unit,
)
from companion.config import Config, load
from companion.output.engine.closer import closer_arguments

DEFAULT_CONFIG = Path("/etc/vrspray/config.toml")
# Who may open serial devices and lines; those that this computer does not have are left out.
_GROUPS = ("dialout", "gpio", "spi")

app = new_app(
    help="Install, remove or show the systemd service.",
    epilog="Example: sudo vrspray service install --config /etc/vrspray/config.toml",
)
OfUser = Annotated[bool, typer.Option("--user", help="A service for this user only, without root.")]


@app.command(epilog="Example: vrspray service install --config field.toml --dry-run")
def install(
    config_file: Annotated[
        Path, typer.Option("--config", metavar="FILE", help="Configuration that the service uses.")
    ] = DEFAULT_CONFIG,
    user: OfUser = False,
    account: Annotated[
        str | None,
        typer.Option("--run-as", metavar="USER", help="User it runs as; default: you."),
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime", help="Real-time priority for the control loop too (not --user)."
        ),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the unit; write nothing.")] = (
        False
    ),
    as_json: AsJson = False,
) -> None:
    """Install the service, to start with the computer.

    Does not start it now.
    """
    config = load(config_file)
    who = account or os.environ.get("SUDO_USER") or getpass.getuser()
    unit = build_unit(config, is_user=user, account=who, is_realtime=realtime)
    path, text = unit_path(is_user=user), unit.text()
    if dry_run:
        answer({"ok": True, "unit": str(path), "text": text}, text.splitlines(), as_json=as_json)
        return
    refuse_foreign(path)
    make_folders(unit.writable, account="" if user else who)
    write_unit(path, text)
    problem = _enable(is_user=user)
    lines = [f"written: {path}", problem or f"enabled: it starts with the computer ({NAME})"]
    how = "systemctl --user" if user else "sudo systemctl"
    lines.append(f"start it now: {how} start {NAME}; see it: vrspray service status")
    if user:
        lines.append(f"to run without a login: sudo loginctl enable-linger {getpass.getuser()}")
    answer(
        {"ok": problem is None, "unit": str(path), "enabled": problem is None, "problem": problem},
        lines,
        as_json=as_json,
    )
    raise typer.Exit(0 if problem is None else 1)


@app.command(epilog="Example: sudo vrspray service uninstall")
def uninstall(user: OfUser = False, as_json: AsJson = False) -> None:
    """Stop and remove the service; keep flights and configuration."""
    path = unit_path(is_user=user)
    was_there = read_unit(path) is not None
    if was_there:
        refuse_foreign(path)
        systemctl("disable", "--now", NAME, is_user=user)
        remove_unit(path)
        systemctl("daemon-reload", is_user=user)
    text = f"removed: {path}" if was_there else f"not installed: {path}"
    answer({"ok": True, "unit": str(path), "removed": was_there}, [text], as_json=as_json)


@app.command(epilog="Example: vrspray service status --json")
def status(user: OfUser = False, as_json: AsJson = False) -> None:
    """Show whether the service is installed, enabled and running.

    Exit 0: it runs; 1: it does not.
    """
    path = unit_path(is_user=user)
    known = properties(is_user=user)
    found: dict[str, Any] = {
        "ok": known is not None and known.get("ActiveState") == "active",
        "unit": str(path),
        "installed": read_unit(path) is not None,
        "enabled": known is not None and known.get("UnitFileState", "").startswith("enabled"),
        "active": None if known is None else known.get("ActiveState"),
        "state": None if known is None else known.get("SubState"),
        "restarts": None if known is None else _number(known.get("NRestarts")),
        "result": None if known is None else known.get("Result"),
    }
    lines = [f"{key}: {_word(value)}" for key, value in found.items() if key != "ok"]
    answer(found, lines, as_json=as_json)
    raise typer.Exit(0 if found["ok"] else 1)


def build_unit(config: Config, *, is_user: bool, account: str, is_realtime: bool) -> Unit:
    """Return the unit for a configuration on this computer."""
    is_gpio = config.output.kind == "gpio"
    closer = closer_arguments(engine_setup(config)) if is_gpio else []
    closer += motor_closer_arguments(config)
    folders = (config.journal.folder, config.link.state_folder)
    try:
        return Unit(
            python=sys.executable,
            config=str(config.path.resolve()),
            writable=tuple(str(config.resolve(folder).resolve()) for folder in folders),
            closer=tuple(closer),
            is_user=is_user,
            account=account,
            groups=tuple(group for group in _GROUPS if _exists(group)),
            is_realtime=is_realtime,
            writes_sysfs=bool(pwm_drives(config)),
            is_guarded=servo_options(config) is not None,
        )
    except ValueError as error:
        raise ServiceError(f"{config.path}: {error}") from error


def make_folders(folders: tuple[str, ...], *, account: str) -> None:
    """Make what the service writes to: its sandbox does not begin without it."""
    for name in folders:
        folder = Path(name)
        if folder.is_dir():
            continue
        try:
            folder.mkdir(parents=True)
            if account and os.geteuid() == 0:
                shutil.chown(folder, user=account)
        except (OSError, LookupError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ServiceError(
                f"{folder}: cannot be made for {account or 'this user'} ({reason.lower()}); make "
                "it, or correct journal.folder and link.state_folder"
            ) from error


def _enable(*, is_user: bool) -> str | None:
    """Have systemd take the unit; return what is wrong."""
    for arguments in (("daemon-reload",), ("enable", NAME)):
        done = systemctl(*arguments, is_user=is_user)
        if done.code != 0:
            return f"systemctl {' '.join(arguments)}: {done.text or 'failed'}"
    return None


def _exists(group: str) -> bool:
    try:
        grp.getgrnam(group)
    except KeyError:
        return False
    return True


def _number(text: str | None) -> int | None:
    return int(text) if text is not None and text.isdecimal() else None


def _word(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "unknown" if value is None else str(value)

"""The serial device of a link: is it there, and may this user open it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from companion.doctor.check import Check, fail, not_applicable, ok
from companion.link.transport import parse_url


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """What is known of a device without opening it."""

    path: str
    exists: bool
    is_permitted: bool
    group: str


def read_device(url: str) -> Device | None:
    """Return the facts of the device; None for a link that has none."""
    parts = parse_url(url)
    if parts.kind != "serial":
        return None
    path = Path(parts.place)
    try:
        group = path.group()
    except (OSError, KeyError):
        group = "dialout"
    return Device(
        path=str(path),
        exists=path.exists(),
        is_permitted=os.access(path, os.R_OK | os.W_OK),
        group=group,
    )


def serial_check(device: Device | None) -> Check:
    """Return whether the device can be used."""
    name = "serial-port"
    if device is None:
        return not_applicable(name, "the link is no serial one")
    if not device.exists:
        fix = "plug it in, or correct link.url; on a Raspberry Pi: enable_uart=1 in config.txt"
        return fail(name, f"{device.path} does not exist", fix)
    if not device.is_permitted:
        fix = f"sudo usermod -aG {device.group} $USER, then log in again"
        return fail(name, f"{device.path}: permission denied", fix)
    return ok(name, f"{device.path} may be opened")

"""The watchdog script of `deploy/ardupilot` as the stub runs it: it closes without a sign of life.

Retold and not run, for the stub has no Lua: what it closes and when, and its parameters.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from sitl.stub.firmware import Autopilot
from sitl.stub.parameters import INT16, INT32, Table
from sitl.stub.protocol import COMPANION_COMPONENT

TIMEOUT_S = 0.3
ENABLE = "SPRW_ENABLE"
_NAMED_VALUE_FLOAT = (251).to_bytes(3, "little")
_SIGN_OF_LIFE = b"SPR_LIVE"
_HEAD = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """The outputs of valves and motors, the one pulse that closes them, and a return valve's."""

    channels: Sequence[int]
    closed_us: int = 1000
    return_channel: int = 0
    return_us: int = 2000

    def table(self) -> Table:
        """Return the script's parameters, which are there while it runs."""
        mask = sum(1 << channel - 1 for channel in self.channels if channel <= 16)
        beyond = [channel for channel in self.channels if channel > 16]
        found = {
            ENABLE: 1, "SPRW_COMPID": COMPANION_COMPONENT, "SPRW_SYSID": 0,
            "SPRW_FIRST": min(beyond, default=0), "SPRW_LAST": max(beyond, default=0),
            "SPRW_MASK": mask, "SPRW_CLOSED_US": self.closed_us, "SPRW_TIMEOUT_MS": 300,
            "SPRW_RET_CH": self.return_channel, "SPRW_RET_US": self.return_us,
        }  # fmt: skip
        return {name: (value, INT32 if value > 32_767 else INT16) for name, value in found.items()}


class Watchdog:
    """A `Script` of the stub."""

    def __init__(self, watched: Watched, autopilot: Autopilot) -> None:
        self._autopilot = autopilot
        self._closed_us = dict.fromkeys(watched.channels, watched.closed_us)
        if watched.return_channel:
            self._closed_us[watched.return_channel] = watched.return_us
        self._heard_s = float("-inf")

    def on_message(self, raw: bytes, now_s: float) -> None:
        """Take a frame in; a sign of life of our companion counts."""
        payload = raw[_HEAD : _HEAD + raw[1]].ljust(18, b"\0")
        is_ours = raw[6] == COMPANION_COMPONENT and raw[7:_HEAD] == _NAMED_VALUE_FLOAT
        if raw[0] == 0xFD and is_ours and payload[8:16] == _SIGN_OF_LIFE:
            (value,) = struct.unpack_from("<f", payload, 4)
            self._heard_s = now_s if value > 0.0 else self._heard_s

    def update(self, now_s: float) -> None:
        """Close what is open, unless the companion lives."""
        if now_s - self._heard_s < TIMEOUT_S or self._autopilot.parameters[ENABLE] != 1.0:
            return
        pulses_us = self._autopilot.outputs.pulses_us(now_s)
        for channel, closed_us in self._closed_us.items():
            if channel <= len(pulses_us) and pulses_us[channel - 1] != closed_us:
                self._autopilot.outputs.write(channel, closed_us, now_s=now_s)

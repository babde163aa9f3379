"""What the vehicle says of its switches and outputs, if it is no older than what it said before.

Where the autopilot's messages come twice or late (two radios, a router's loop), an old pulse of the
pilot's switch would enable again after he has stopped, and an old output would look like a fault.
Both carry the autopilot's time since boot; the positions tell what that is by now.
"""

from __future__ import annotations

import math

from companion.core.order import AHEAD_MAX_S, BOOT_WRAP_S, Order
from companion.core.types import RcReport
from companion.link.messages import Message, ServoOutput

# SERVO_OUTPUT_RAW counts microseconds in 32 bits, which begin anew after 72 minutes.
_MICROS_WRAP_S = 2**32 / 1e6


class News:
    """Remembers how new the last message of each kind was."""

    def __init__(self) -> None:
        self._newest: dict[str, float] = {}

    def begin_anew(self) -> None:
        """Forget it: the autopilot's clock has begun anew."""
        self._newest.clear()

    def is_old(self, message: Message, order: Order) -> bool:
        """Return whether something newer is known; what has no time is as new as it comes.

        What is ahead of the positions is of the clock before it began anew.
        """
        if not isinstance(message, RcReport | ServoOutput) or message.boot_s is None:
            return False
        boot_s = message.boot_s
        kind, wrap_s = "rc", BOOT_WRAP_S
        if isinstance(message, ServoOutput):
            kind, wrap_s = f"port {message.port}", _MICROS_WRAP_S
        if order.boot_s is not None:
            now_s = order.boot_s + message.received_s - order.received_s
            if math.remainder(boot_s - now_s, wrap_s) > AHEAD_MAX_S:
                return True
        newest_s = self._newest.get(kind)
        if newest_s is not None and math.remainder(boot_s - newest_s, wrap_s) < 0.0:
            return True
        self._newest[kind] = boot_s
        return False

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
# For so long after a restart something of before it may still come.
_LATE_MAX_S = 30.0


class News:
    """Remembers how new the last message of each kind was."""

    def __init__(self) -> None:
        self._newest: dict[str, float] = {}
        self._wary_until_s = -math.inf

    def begin_anew(self, now_s: float) -> None:
        """Forget it: the autopilot's clock has begun anew."""
        self._newest.clear()
        self._wary_until_s = now_s + _LATE_MAX_S

    def is_old(self, message: Message, order: Order) -> bool:
        """Return whether something newer is known; what has no time is as new as it comes.

        After a restart what is ahead of the positions is of the clock before it.
        """
        if not isinstance(message, RcReport | ServoOutput) or message.boot_s is None:
            return False
        boot_s = message.boot_s
        kind, wrap_s = "rc", BOOT_WRAP_S
        if isinstance(message, ServoOutput):
            kind, wrap_s = f"port {message.port}", _MICROS_WRAP_S
        if order.boot_s is not None and message.received_s < self._wary_until_s:
            now_s = order.boot_s + message.received_s - order.received_s
            if math.remainder(boot_s - now_s, wrap_s) > AHEAD_MAX_S:
                return True
        newest_s = self._newest.get(kind)
        if newest_s is not None and math.remainder(boot_s - newest_s, wrap_s) < 0.0:
            return True
        self._newest[kind] = boot_s
        return False

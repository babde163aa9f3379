"""Virtual time: an event loop whose clock jumps to the next timer, and a wire inside this process.

Computing takes no time and nothing is late, on however busy a computer: what a flight is asked for
is exact, and it takes as long as its computing does. Tests marked `virtual_time` run on such a
loop. Whatever comes from outside (a socket, a process, a thread) is not waited for: what those do
is tested in real time.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable

from companion.link.vehicle_link import VehicleLink

# Not that of the computer, which rounds otherwise after some hours: flights are the same again.
START_S = 5000.0
WIRE_S = 0.0005
# Between two that are sent at once.
ORDER_S = 1e-9


class _Jump(selectors.SelectSelector):
    """Waits for nothing: what would be waited for becomes the time."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0.0)
        # A signal that is there already comes before any timer.
        if not found and timeout is not None and timeout > 0.0:
            self.now_s += timeout
        return found


class JumpingLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is what its timers say."""

    def __init__(self, start_s: float = START_S) -> None:
        self._jump = _Jump()
        self._jump.now_s = start_s
        super().__init__(self._jump)
        # Python's development mode keeps the stack of every timer, which takes longer than a
        # flight; what it looks for (calls from other threads) is looked for in real time.
        self.set_debug(False)

    def time(self) -> float:
        return self._jump.now_s


def now_s() -> float:
    """Return the time of the running loop: that of the computer, or a virtual one."""
    return asyncio.get_running_loop().time()


class Delivery:
    """One way of a wire: what is sent arrives after a moment, in its order."""

    def __init__(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver
        self._last_s = 0.0

    def send(self, data: bytes, *, wait_s: float = 0.0) -> None:
        """Have `data` arrive; timers of one time would come in any order."""
        loop = asyncio.get_running_loop()
        self._last_s = max(loop.time() + WIRE_S + wait_s, self._last_s + ORDER_S)
        loop.call_at(self._last_s, self._deliver, data)


class _Wire:
    """The companion's end: a transport that delivers after a moment."""

    is_up = True
    speaker = None

    def adopt(self, speaker: object, now_s: float, *, is_vehicle: bool) -> None:
        """Do nothing: there is one other end."""

    def __init__(self, deliver: Callable[[bytes], None]) -> None:
        self._delivery = Delivery(deliver)

    def send(self, data: bytes) -> bool:
        self._delivery.send(data)
        return True

    async def close(self) -> None:
        await asyncio.sleep(2.0 * WIRE_S)


class WireLink(VehicleLink):
    """A link whose other end is in this process."""

    deliver: Callable[[bytes], None] = staticmethod(lambda _: None)

    async def open(self, wake: Callable[[], None]) -> None:
        """Open at once."""
        self._wake = wake
        self._transport = _Wire(lambda data: self.deliver(data))
        self._watch.link_up(self._clock())

    def arrive(self, data: bytes) -> None:
        """Take what the vehicle has sent."""
        self._on_bytes(data)

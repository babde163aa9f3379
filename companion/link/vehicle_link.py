"""The link as the runtime knows it: a transport with a component behind it."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable

from companion.core.types import Decision, Input
from companion.link.component import Component, ComponentOptions
from companion.link.transport import Transport, open_transport

_logger = logging.getLogger(__name__)

# Chunks that wait for the control loop. It empties them within a millisecond; a loop that is
# behind by this many has other troubles than the oldest bytes.
_CHUNKS_MAX = 512


class VehicleLink:
    """Implements `companion.ports.VehicleLink` by MAVLink.

    Bytes are stamped when they arrive and decoded when the control loop asks, so that whatever
    goes wrong with them goes wrong inside the loop, whose `finally` closes the valves.
    """

    def __init__(
        self,
        url: str,
        options: ComponentOptions,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._url = url
        self._clock = clock
        self._chunks: deque[tuple[bytes, float]] = deque(maxlen=_CHUNKS_MAX)
        self._transport: Transport | None = None
        self._wake: Callable[[], None] = _nothing
        self.component = Component(options, self._send)
        self._changed = False
        self._heard, self._told = True, True

    @property
    def fault(self) -> str | None:
        """Return why nothing reaches the vehicle; None while the link is up.

        A link that was away counts as up again once a step has been taken, which orders all
        closed, and the vehicle has been heard: nothing opens on what was known before.
        """
        if self._transport is None or not self._transport.is_up:
            return "link is down"
        return None if self._heard and self._told else "link is coming back"

    async def open(self, wake: Callable[[], None]) -> None:
        """Open the link; raises a `LinkError`."""
        self._wake = wake
        self._transport = await open_transport(self._url, self._on_bytes, self._on_change)
        _logger.info("link up: %s", self._url)

    def on_order_ack(self, take: Callable[[int], None]) -> None:
        """Have the result (MAV_RESULT) of every order that is answered given to `take`."""
        self.component.on_order_ack = take

    def receive(self) -> list[Input]:
        """Return what came in since the last call, in its order."""
        if self._changed:
            self._changed = False
            self.component.link_changed(self._clock())
        inputs: list[Input] = []
        while self._chunks:
            data, received_s = self._chunks.popleft()
            inputs.extend(self.component.receive(data, received_s))
        self._heard = self._heard or bool(inputs)
        return inputs

    def order(self, channel: int, pulse_us: int) -> bool:
        """Order a servo output; False where the order could not leave."""
        return self.component.order(channel, pulse_us)

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Send what is due: sign of life, heartbeat, texts, values, requests."""
        self.component.tick(decision, now_s)
        self._told = self._told or self._transport is None or self._transport.is_up

    def tell_fault(self, text: str) -> None:
        """Tell the operator once of something that does not work."""
        self.component.fault(text)

    async def close(self) -> None:
        """Let go; may be called twice and before `open`."""
        transport, self._transport = self._transport, None
        if transport is not None:
            await transport.close()
            _logger.info("link closed: %s", self._url)

    def _send(self, data: bytes) -> bool:
        return self._transport is not None and self._transport.send(data)

    def _on_bytes(self, data: bytes) -> None:
        self._chunks.append((data, self._clock()))
        self._wake()

    def _on_change(self, is_up: bool) -> None:
        _logger.warning("link %s: %s", "is back" if is_up else "was lost", self._url)
        self._changed = is_up
        self._heard = self._told = False
        self._chunks.clear()
        self._wake()


def _nothing() -> None:
    """Do nothing: there is no one to wake yet."""

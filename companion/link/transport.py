"""From a link URL to something that sends bytes and hands over bytes; no threads, no polling.

`send` never waits and never raises: it returns False where the bytes could not leave, and the
sender decides whether they are still worth sending later. Old orders are not queued up.
"""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from companion.errors import LinkError

OnBytes = Callable[[bytes], None]
OnChange = Callable[[bool], None]
OnTrouble = Callable[[str], None]

BACK_OFF_MIN_S, BACK_OFF_MAX_S = 0.5, 5.0
CLOSE_WAIT_S = 0.5
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class LinkNotYetError(LinkError):
    """The link cannot be opened now, and may be later: a device to plug in, a router to start."""


class Transport(Protocol):
    """An open link."""

    is_up: bool
    speaker: Any  # where the bytes that are being handed over came from, where there are several

    def send(self, data: bytes) -> bool:
        """Send now or not at all; return whether it left."""

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Take that a valid frame came from `speaker`, of the vehicle's system or of another."""

    async def close(self) -> None:
        """Let what was sent go out, for half a second at most, and let go."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkUrl:
    """A link URL in its parts; `number` is the port or the baud rate."""

    kind: str
    place: str
    number: int
    text: str


def parse_url(url: str) -> LinkUrl:
    """Return the parts of `url`, or raise a `LinkError` that says what to write.

    >>> parse_url("udpin:127.0.0.1:14550").number
    14550
    """
    kind, _, rest = url.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not place:
        raise LinkError(f"link.url = {url!r}: not a link; write {_FORMS}")
    if not (number.isascii() and number.isdigit()):
        what = "baud rate" if kind == "serial" else "port"
        raise LinkError(f"link.url = {url!r}: {number!r} is no {what}; write {_FORMS}")
    value = int(number)
    if kind != "serial" and not (0 if kind == "udpin" else 1) <= value <= 65535:
        raise LinkError(f"link.url = {url!r}: port {value} does not exist; write 1 to 65535")
    return LinkUrl(kind=kind, place=place.strip("[]"), number=value, text=url)


def serial_baud(url: str) -> int | None:
    """Return the baud rate of a serial link; None for any other, whose speed is not known.

    >>> serial_baud("serial:/dev/ttyAMA0:57600"), serial_baud("udpin:127.0.0.1:14550")
    (57600, None)
    """
    return parse_url(url).number if url.startswith("serial:") else None


class Reconnecting:
    """What links that can be lost have in common: they try again with growing pauses."""

    def __init__(
        self,
        url: LinkUrl,
        on_bytes: OnBytes,
        on_change: OnChange,
        on_trouble: OnTrouble | None = None,
    ) -> None:
        self.url = url
        self.is_up = False
        self.speaker: Any = None
        self._on_bytes = on_bytes
        self._on_change = on_change
        self._on_trouble = on_trouble
        self._said: str | None = None
        self._again: asyncio.Task[None] | None = None
        self._closed = False

    async def open(self) -> None:
        """Connect for the first time, or begin to try; raises a `LinkError`."""
        try:
            await self._connect()
        except LinkNotYetError as error:
            if self._on_trouble is None:
                raise
            self._say(error)
            self._try_soon()
        else:
            self.is_up = True

    def _say(self, error: LinkError) -> None:
        """Tell why it is down, once for each reason."""
        if self._on_trouble is not None and str(error) != self._said:
            self._said = str(error)
            self._on_trouble(self._said)

    @abstractmethod
    async def _connect(self) -> None:
        """Connect, or raise a `LinkError` of one line."""

    @abstractmethod
    def send(self, data: bytes) -> bool:
        """Send now or not at all; return whether it left."""

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Do nothing: there is one other end, and we chose it."""

    async def close(self) -> None:
        """Stop trying and let go."""
        self._closed = True
        self.is_up = False
        if self._again is not None:
            self._again.cancel()
            await asyncio.gather(self._again, return_exceptions=True)
            self._again = None
        await self._let_go()

    @abstractmethod
    async def _let_go(self) -> None:
        """Let what was sent go out, and close."""

    def _lost(self) -> None:
        """Tell of the loss and begin to try again."""
        if self._closed or not self.is_up:
            return
        self.is_up = False
        self._on_change(False)
        self._try_soon()

    def _try_soon(self) -> None:
        self._again = asyncio.get_running_loop().create_task(self._try_again())

    async def _try_again(self) -> None:
        pause_s = BACK_OFF_MIN_S
        while not self.is_up:
            await asyncio.sleep(pause_s)
            try:
                await self._connect()
            except LinkError as error:
                self._say(error)
                pause_s = min(2.0 * pause_s, BACK_OFF_MAX_S)
            else:
                self.is_up = True
                self._said = None
                self._on_change(True)

"""One peer on the wire: what was heard of it, what it asked for, and how it is reached."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sitl.stub.protocol import Listener, SigningKey


@dataclass(slots=True)
class Stream:
    """One message that a peer asked for, and when it is next due."""

    interval_s: float
    due_s: float


class Channel:
    """A peer's side of the link.

    Rates are kept by peer because a firmware keeps them by port: whoever speaks last on a port
    sets the rates for everybody on it.
    """

    def __init__(
        self, name: str, send: Callable[[bytes], None], *, key: SigningKey | None = None
    ) -> None:
        self.name = name
        self.send = send
        self.listener = Listener(key)
        self.heard: set[tuple[int, int]] = set()
        self.streams: dict[int, Stream] = {}
        self.busy_until_s = 0.0
        self.parameters_left: list[int] = []
        self.parameters_due_s = 0.0

    def ask(
        self,
        message_id: int,
        interval_s: float | None,
        *,
        now_s: float,
        kinds_max: int | None = None,
    ) -> None:
        """Set the interval of a stream; none ends it.

        ArduPilot keeps ten different intervals a port and takes the nearest of them for any more.
        """
        self.streams.pop(message_id, None)
        if interval_s is None:
            return
        kept = {stream.interval_s for stream in self.streams.values()}
        if kinds_max is not None and len(kept) >= kinds_max:
            wanted_s = interval_s
            interval_s = min(kept, key=lambda kept_s: abs(kept_s - wanted_s))
        self.streams[message_id] = Stream(interval_s=interval_s, due_s=now_s)

    def due(self, now_s: float, *, slow_factor: float) -> list[int]:
        """Return the ids of the messages that are due, and count them as sent.

        A stream that fell behind by more than its interval goes on from now: a firmware skips,
        it does not catch up.
        """
        due = []
        for message_id, stream in self.streams.items():
            if stream.due_s <= now_s:
                due.append(message_id)
                interval_s = stream.interval_s * slow_factor
                stream.due_s += interval_s
                if stream.due_s <= now_s:
                    stream.due_s = now_s + interval_s
        return due

    def next_due_s(self) -> float:
        """Return when the next message is due; infinite without streams."""
        return min((stream.due_s for stream in self.streams.values()), default=float("inf"))

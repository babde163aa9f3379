"""What waits for the control loop, by who sent it, and what each sender may cost.

Anyone can send to a port. So bytes wait by sender, a turn takes a slice of each, and who has sent
more than there is room for loses it, counted, and nobody else anything.
"""

from __future__ import annotations

from collections import deque
from operator import itemgetter
from typing import Any

from companion.link.framer import Counts, Framer

# A turn reads so much of each sender; a chunk counts as some bytes however short it is.
SLICE_BYTES, CHUNK_BYTES_MIN = 2048, 64
SOURCES_MAX = 16
# A frame of which nothing is read costs its checksum (and signature) only.
UNREAD_COST = 0.1

# Shares: so much a second, and so much at once. First whoever was adopted, and the other end of a
# line that we chose: twenty times the fastest serial line. On each the vehicle's own frames have a
# share, and so has each other component; what is beyond these shares one.
KNOWN_BYTES = (2e6, 1 << 20)
VEHICLE_FRAMES, OTHER_FRAMES, OTHERS_MAX = (1000, 200), (100, 50), 16
# Then each stranger, of whom a heartbeat of 21 bytes is enough, and all of them together.
STRANGER_BYTES, STRANGERS_BYTES = (16e3, 4096), (48e3, 12_288)
STRANGER_FRAMES = (50, 20)


class Budget:
    """What may be spent: so much a second, and so much at once."""

    def __init__(self, a_second: float, at_once: float) -> None:
        self._a_second, self._at_once = a_second, at_once
        self._left, self._at_s = at_once, float("-inf")

    def spend(self, amount: float, now_s: float) -> bool:
        """Spend it if there is as much; time that goes back brings nothing."""
        if now_s > self._at_s:
            self._left = min(self._at_once, self._left + self._a_second * (now_s - self._at_s))
            self._at_s = now_s
        if not amount <= self._left:
            return False
        self._left -= amount
        return True


class Source:
    """One sender: its framer, what waits of it, and what it may still cost; anything, by itself."""

    def __init__(self, counts: Counts, speaker: Any = None) -> None:
        self.framer = Framer(counts)
        self.speaker = speaker
        self.is_known: bool | None = None
        self.waiting: deque[tuple[int, bytes, float]] = deque()
        self._bytes: tuple[Budget, ...] = ()
        self._frames: dict[Any, Budget] = {}

    def know(self, strangers: Budget, *, is_known: bool) -> None:
        """Give it what its kind may cost, where it has become of another kind."""
        if is_known is self.is_known:
            return
        self.is_known = self.framer.may_split = is_known
        self._frames = {None: Budget(*(VEHICLE_FRAMES if is_known else STRANGER_FRAMES))}
        own = Budget(*(KNOWN_BYTES if is_known else STRANGER_BYTES))
        self._bytes = (own,) if is_known else (own, strangers)

    def may_read(self, count: int, now_s: float) -> bool:
        """Whether so many more bytes may wait."""
        return all(budget.spend(count, now_s) for budget in self._bytes)

    def may_decode(self, sender: tuple[int, int] | None, *, is_read: bool, now_s: float) -> bool:
        """Whether a frame of a component may be looked into; `sender` is None for the vehicle."""
        if self.is_known is None:
            return True
        key: Any = sender if self.is_known else None
        if key not in self._frames:
            key = key if len(self._frames) <= OTHERS_MAX else ()
            self._frames.setdefault(key, Budget(*OTHER_FRAMES))
        cost = 1.0 if is_read else UNREAD_COST
        return self._frames[key].spend(cost, now_s)


class Intake:
    """Keeps senders apart until the control loop asks."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._sources: dict[Any, Source] = {}
        self.strangers = Budget(*STRANGERS_BYTES)
        self._number = 0

    def put(self, data: bytes, at_s: float, speaker: Any, *, is_known: bool) -> bool:
        """Have bytes wait as far as they may; return whether any do."""
        source = self._source(speaker)
        source.know(self.strangers, is_known=is_known)
        had = len(source.waiting)
        # Of a stranger's datagram all is read, or nothing.
        size = SLICE_BYTES if is_known else max(len(data), 1)
        for begin in range(0, len(data), size):
            piece = data[begin : begin + size]
            if source.may_read(max(len(piece), CHUNK_BYTES_MIN), at_s):
                self._number += 1
                source.waiting.append((self._number, piece, at_s))
            else:
                self._drop(piece)
        return len(source.waiting) > had

    def _source(self, speaker: Any) -> Source:
        """Return who speaks, as the last one that did; the longest silent stranger makes room."""
        found = self._sources.pop(speaker, None) or Source(self._counts, speaker)
        if len(self._sources) >= SOURCES_MAX:
            gone = min(self._sources.values(), key=lambda one: one.is_known is True)
            del self._sources[gone.speaker]
            for _, piece, _ in gone.waiting:
                self._drop(piece)
        self._sources[speaker] = found
        return found

    def _drop(self, piece: bytes) -> None:
        self._counts.bytes_in += len(piece)
        self._counts.excess_bytes += len(piece)

    def take(self) -> list[tuple[bytes, float, Source]]:
        """Return a slice of each sender's, as they came; of strangers last."""
        taken = []
        for source in self._sources.values():
            left = SLICE_BYTES
            while source.waiting and left > 0:
                number, data, at_s = source.waiting.popleft()
                left -= max(len(data), CHUNK_BYTES_MIN)
                taken.append((not source.is_known, number, data, at_s, source))
        return [one[2:] for one in sorted(taken, key=itemgetter(0, 1))]

    def has_more(self) -> bool:
        """Whether something waits still."""
        return any(source.waiting for source in self._sources.values())

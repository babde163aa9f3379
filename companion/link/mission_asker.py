"""Asks which item of the mission is flown, where an autopilot does not stream that.

PX4 says it at a change and every ten seconds, and refuses it as a stream. Whether it answers a
request for one message was not tried on the firmware: the first refusal ends the asking, and so
do a few requests in vain. Pure but for what it remembers; time is an argument.
"""

from __future__ import annotations

from companion.link.encode import Encoder

_MISSION_CURRENT, _REQUEST_MESSAGE = 42, 512
# What the message is said to come at where it is streamed (common.xml: nominally at 1 Hz).
_EVERY_S = 1.0
_TRIES = 3
# The wire may have been down for all of them.
_AGAIN_S = 30.0
_REFUSED = frozenset({2, 3, 4})  # MAV_RESULT denied, unsupported, failed
_NEVER_S = float("-inf")


class MissionAsker:
    """Says when to ask for a MISSION_CURRENT; nothing where they are streamed."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self.meet(is_streamed=True)

    def meet(self, *, is_streamed: bool) -> None:
        """Take another vehicle, or one that has forgotten us."""
        self._is_over = is_streamed
        self._tries = 0
        self._asked_s = self._heard_s = _NEVER_S

    def heard(self, now_s: float) -> None:
        """Take a MISSION_CURRENT, asked for or not."""
        if now_s - self._asked_s < _EVERY_S:
            self._tries = 0
        self._heard_s = now_s

    def answered(self, result: int) -> None:
        """Take the acknowledgement of a request."""
        self._is_over = self._is_over or result in _REFUSED

    def due(self, now_s: float) -> bytes | None:
        """Return a request, where one is due."""
        if self._is_over or now_s - max(self._heard_s, self._asked_s) < _EVERY_S:
            return None
        if self._tries >= _TRIES and now_s - self._asked_s < _AGAIN_S:
            return None
        self._tries = self._tries % _TRIES + 1
        self._asked_s = now_s
        return self._encoder.command(_REQUEST_MESSAGE, float(_MISSION_CURRENT))

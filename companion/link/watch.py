"""Watches a link that is up, and says in one line what is wrong with it."""

from __future__ import annotations

import logging

from companion.link.component import Component
from companion.link.findings import Finding, Seen, Teller, find
from companion.link.modes import autopilot_name
from companion.link.service import OnEvent
from companion.link.transport import LinkUrl, parse_url

_logger = logging.getLogger(__name__)

_LOOK_S = 0.5


class Watch:
    """Compares what came in since the link came up with what must come in."""

    def __init__(self, url: str, component: Component, tell: OnEvent) -> None:
        self._url_text = url
        self._url: LinkUrl | None = None
        self._component = component
        self._tell = tell
        self._teller = Teller()
        self._up_s: float | None = None
        self._looked_s = float("-inf")
        self._before = (0, 0, 0)
        self._is_met = False
        self._is_twin_told = False

    def link_up(self, now_s: float) -> None:
        """Begin to count anew."""
        self._up_s = now_s
        self._before = self._counts()

    def _counts(self) -> tuple[int, int, int]:
        codec = self._component.codec
        return codec.byte_count, codec.frame_count, codec.refused_frame_count

    def look(self, now_s: float) -> None:
        """Say what is new; called at every step."""
        if self._up_s is None or now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        self._greet(now_s)
        self._look_for_twin(now_s)
        finding = self._teller.news(self._find(now_s, self._up_s), now_s)
        if finding is not None:
            _logger.warning("%s", finding.text)
            self._component.warn(finding.short)
            self._tell(now_s, "link", finding.text)

    def _find(self, now_s: float, up_s: float) -> Finding | None:
        component = self._component
        now, before = self._counts(), self._before
        met_s = component.met_s
        seen = Seen(
            up_s=now_s - up_s,
            byte_count=now[0] - before[0],
            frame_count=now[1] - before[1],
            refused_count=now[2] - before[2],
            asked_s=None if component.is_answered or met_s is None else now_s - met_s,
            now_s=now_s,
        )
        return find(self._parsed(), component.codec.census, seen)

    def _parsed(self) -> LinkUrl:
        if self._url is None:
            self._url = parse_url(self._url_text)
        return self._url

    def _greet(self, now_s: float) -> None:
        vehicle = self._component.codec.vehicle
        if vehicle is None or self._is_met:
            return
        self._is_met = True
        text = f"vehicle: system {vehicle.system_id}, {autopilot_name(vehicle.autopilot)}"
        _logger.info("%s", text)
        self._tell(now_s, "link", text)

    def _look_for_twin(self, now_s: float) -> None:
        """Say once that another component speaks as we do: routers then lose half of both."""
        system_id, component_id = self._component.address
        if self._is_twin_told or not self._component.codec.census.is_heard(
            system_id, component_id, now_s
        ):
            return
        self._is_twin_told = True
        text = f"another component speaks as {system_id}/{component_id}, or our own bytes come back"
        _logger.warning("%s: set link.component_id to a number that nobody has", text)
        self._component.warn(f"{system_id}/{component_id} twice: set link.component_id")
        self._tell(now_s, "link", text)

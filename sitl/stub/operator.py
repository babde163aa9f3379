"""The friendly operator: waits for mission and companion, flies, enables spraying, lands.

It holds the stub's transmitter (arming, modes) and a ground station (255/190), from which
MAV_CMD_DO_SPRAYER goes to the companion over the same link.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from sitl.stub.autopilot import Autopilot
from sitl.stub.modes import AUTO, LAND, LOITER, Phase
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    COMPANION_COMPONENT,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Message,
    SigningKey,
    Speaker,
    dialect,
    sender,
)

# After the first heartbeat: time to ask for streams and to decide that all is well.
_SETTLE_S = 3.0
_RETRY_S = 0.5
_RETRY_ARMING_S = 5.0


class Step(Enum):
    """How far the operator has come."""

    NO_MISSION = "waiting for a mission"
    WAITING = "waiting for a companion"
    SETTLING = "companion heard"
    FLYING = "flying"
    LANDING = "landing"
    DONE = "landed"


class Operator:
    """Acts at each `tick`; `enabled` says whether the companion has taken the enable.

    With `mission_is_there` it waits for that first, and then for a companion that beats afterwards:
    what was on the link before may have gone. `since_s` is when it began to wait. Where the link is
    signed, so is what its ground station sends.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        *,
        enable: bool = True,
        mission_is_there: Callable[[], bool] | None = None,
        key: SigningKey | None = None,
        start_s: float = 0.0,
    ) -> None:
        self._start_s = start_s
        self.step = Step.WAITING if mission_is_there is None else Step.NO_MISSION
        self.since_s = start_s
        self.enabled = False
        self.companion_texts: list[str] = []
        self._autopilot = autopilot
        self._enable = enable
        self._mission_is_there = mission_is_there
        self._ground = Speaker(GROUND_SYSTEM, GROUND_COMPONENT, key=key)
        self._heard_s: float | None = None
        self._due_s = 0.0
        autopilot.hears = self.hear

    def hear(self, message: Message, now_s: float) -> None:
        """Listen to what the companion sends."""
        if sender(message)[1] != COMPANION_COMPONENT:
            return
        kind = message.get_type()
        if kind == "HEARTBEAT" and self._heard_s is None:
            self._heard_s = now_s
        elif kind == "STATUSTEXT":
            self.companion_texts.append(str(message.text))
        elif kind == "COMMAND_ACK" and message.command == dialect.MAV_CMD_DO_SPRAYER:
            self.enabled = message.result == dialect.MAV_RESULT_ACCEPTED

    def tick(self, now_s: float) -> None:
        """Take the step that is due."""
        flight = self._autopilot.flight
        if self.step is Step.NO_MISSION:
            self._look_for_mission(now_s)
        elif self.step is Step.WAITING and self._heard_s is not None:
            self.step = Step.SETTLING
        elif self.step is Step.SETTLING and now_s - (self._heard_s or now_s) >= _SETTLE_S:
            self._take_off(now_s)
        elif self.step is Step.FLYING:
            self._attend(now_s)
        elif self.step is Step.LANDING and flight.phase is Phase.GROUND:
            self.step = Step.DONE

    def _look_for_mission(self, now_s: float) -> None:
        if self._mission_is_there is None or self._mission_is_there():
            self.step, self.since_s, self._heard_s = Step.WAITING, now_s, None

    def _take_off(self, now_s: float) -> None:
        """Arm and start the mission; a refusal is tried again, but not at every tick."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + _RETRY_ARMING_S
        flight = self._autopilot.flight
        ready = flight.set_mode(LOITER, now_s) and flight.arm(now_s)
        if ready and flight.start_mission(now_s):
            self.step, self._due_s = Step.FLYING, now_s

    def _attend(self, now_s: float) -> None:
        """Enable once in the air, and see to the landing."""
        flight = self._autopilot.flight
        if flight.phase is Phase.DESCEND or not flight.in_air:
            self.step = Step.LANDING
        elif flight.mission_complete and flight.phase is Phase.HOVER and not flight.will_land:
            if flight.mode == AUTO:
                flight.set_mode(LAND, now_s)
        elif flight.phase is Phase.ROUTE and self._enable and not self.enabled:
            self._send_enable(now_s)

    def _send_enable(self, now_s: float) -> None:
        if now_s < self._due_s:
            return
        self._due_s = now_s + _RETRY_S
        self._ground.keep_time(now_s - self._start_s)
        command = dialect.MAVLink_command_long_message(
            AUTOPILOT_SYSTEM,
            COMPANION_COMPONENT,
            dialect.MAV_CMD_DO_SPRAYER,
            0,
            *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        )
        self._autopilot.relay(self._ground.frame(command))

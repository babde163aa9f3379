"""What is said of the reasons for which ground work was not done, or ended."""

from __future__ import annotations

from collections.abc import Iterable

from companion.cli.hand import ENDED, INTERRUPTED, KEY
from companion.core.ground_work import GroundReason

_WORDS: dict[str, str] = {
    GroundReason.NO_HEARTBEAT: "no vehicle is heard; check link.url and power",
    GroundReason.STALE_HEARTBEAT: "the vehicle is heard no more",
    GroundReason.ARMED: "the vehicle is armed; disarm it",
    GroundReason.MISSION_MODE: "the vehicle is in a mode that flies missions or may spray; choose "
    "another, such as LOITER",
    GroundReason.MISSION_ACTIVE: "the vehicle's mission is active; end it",
    GroundReason.LANDED_UNKNOWN: "the vehicle does not say whether it stands (EXTENDED_SYS_STATE)",
    GroundReason.NOT_LANDED: "the vehicle does not say that it stands on the ground",
    GroundReason.OUTPUT_FAULT: "the outputs are not sound",
    GroundReason.OUTPUTS_NEED_ARMING: "servo outputs of this autopilot follow orders only while it "
    'is armed (PX4), and ground work needs it disarmed; use valves on GPIO (output.kind = "gpio")',
    GroundReason.STOPPED: "stopped by MAVLink or by the emergency stop",
    GroundReason.ESTOP_UNKNOWN: "the emergency stop is pressed or cannot be read",
    GroundReason.NOT_HELD: "the key was let go",
    GroundReason.STALLED: "this computer stood still for a moment",
    GroundReason.TIME_OVER: "the time of one piece is over; start anew",
    GroundReason.DONE: "done",
    KEY: "another key was pressed",
    ENDED: "stdin ended",
    INTERRUPTED: "interrupted",
}


def in_words(reasons: Iterable[str], fault: str = "") -> str:
    """Return the reasons in one line; `fault` is what outputs or link said."""
    named = [str(reason) for reason in GroundReason if reason in set(reasons)]
    named += sorted(reason for reason in set(reasons) if reason not in named)
    words = [_WORDS.get(reason, reason) for reason in named]
    if GroundReason.OUTPUT_FAULT in named and fault:
        words[named.index(GroundReason.OUTPUT_FAULT)] += f" ({fault})"
    return "; ".join(words)

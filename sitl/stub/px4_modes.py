"""PX4's modes: a main and a sub mode in one word (px4_custom_mode.h), and who is who.

The flight itself counts in ArduCopter's numbers; here they are translated.
"""

from __future__ import annotations

from sitl.stub.modes import AUTO, BRAKE, GUIDED, LAND, LOITER, RTL
from sitl.stub.protocol import dialect

_MANUAL, _ALTCTL, _POSCTL, _AUTO, _ACRO, _OFFBOARD, _STABILIZED = 1, 2, 3, 4, 5, 6, 7
_TAKE_OFF, _HOLD, _MISSION, _RETURN, _LAND = 2, 3, 4, 5, 6

# A take-off by command flies in the internal GUIDED.
_WORDS: dict[int, tuple[int, int]] = {
    LOITER: (_AUTO, _HOLD),
    AUTO: (_AUTO, _MISSION),
    RTL: (_AUTO, _RETURN),
    LAND: (_AUTO, _LAND),
    GUIDED: (_AUTO, _TAKE_OFF),
    BRAKE: (_AUTO, _HOLD),
    dialect.COPTER_MODE_POSHOLD: (_POSCTL, 0),
    dialect.COPTER_MODE_ALT_HOLD: (_ALTCTL, 0),
    dialect.COPTER_MODE_STABILIZE: (_STABILIZED, 0),
}
_MODES = {word: mode for mode, word in _WORDS.items() if mode != BRAKE}


def custom_mode(mode: int) -> int:
    """Return the word of HEARTBEAT for an internal mode.

    >>> hex(custom_mode(3))
    '0x4040000'
    """
    main, sub = _WORDS[mode]
    return main << 16 | sub << 24


def mode_of(main: int, sub: int) -> int | None:
    """Return the internal mode; AUTO without a sub mode is Hold, as in PX4."""
    if main == _AUTO and sub == 0:
        return LOITER
    return _MODES.get((main, sub if main == _AUTO else 0))


def base_mode(mode: int, *, armed: bool) -> int:
    """Return the flags of HEARTBEAT."""
    flags: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    main, _ = _WORDS[mode]
    flags |= dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    if main == _AUTO:
        flags |= dialect.MAV_MODE_FLAG_AUTO_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    else:
        flags |= dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    return flags | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)

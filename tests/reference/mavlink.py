"""What the companion says and hears on the link: messages, commands, parameters, values."""

from __future__ import annotations

import ast
import inspect
import re

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link import announcer, codec, encode
from companion.link import service as link_commands
from companion.link.parameters import SETTINGS, known_parameters

INTRODUCTION = """# MAVLink

The companion is component 191 (`link.component_id`) of the vehicle's system, type ONBOARD_CONTROLLER.
It speaks MAVLink 2 and understands both versions, with signing if a key is set.
"""
COMMANDS: dict[int, str] = {
    link_commands.DO_SPRAYER: "parameter 1 = 1 enables spraying, 0 disables it and ends an emergency stop",
    link_commands.USER_RATE: "rate override: parameter 1 in percent, 80 to 110, of what the map "
    "prescribes; never above `product.rate_max_l_ha`; 100 after every start",
    link_commands.USER_REFILLED: "refilled: parameter 1 in litres, 0 for a full tank; not while spraying",
    link_commands.USER_NEXT_MAP: "next map: denied, there is only one",
    link_commands.USER_ESTOP: "emergency stop, whatever its parameters",
    link_commands.REQUEST_MESSAGE: "send HEARTBEAT, PARAM_VALUE (parameter 2: index), AUTOPILOT_VERSION, "
    "NAMED_VALUE_FLOAT or STATUSTEXT once",
    link_commands.REQUEST_CAPABILITIES: "send AUTOPILOT_VERSION",
    link_commands.SET_MESSAGE_INTERVAL: f"rate of NAMED_VALUE_FLOAT, {link_commands.VALUES_HZ_MIN:g} to "
    f"{link_commands.VALUES_HZ_MAX:g} Hz",
    link_commands.GET_MESSAGE_INTERVAL: "say that rate",
    link_commands.PREFLIGHT_REBOOT_SHUTDOWN: "denied",
}
PARAMETERS: dict[str, str] = {
    "SPR_RATE_PCT": "rate override in percent, at once; 100 after every start",
    "SPR_VAL_HZ": "how often the values below are sent, in Hz",
    "SPR_TANK_L": "litres in a full tank (`mission.tank_l` at first); 0: not known",
}
VALUES: dict[str, str] = {
    "SPR_STATE": "0 boot, 1 safe, 2 ready, 3 armed, 4 spraying, 5 fault, 6 emergency stop",
    "SPR_RATE": "mean of the prescribed rates, L/ha",
    "SPR_PCT": "rate override in force, %",
    "SPR_FLOW": "flow that the orders in force stand for, L/min; not measured",
    "SPR_DUTY": "mean duty cycle, 0 to 1",
    "SPR_TRAIN": "only where no product is sprayed: 1 water, 2 dry run, 3 ground work",
    "SPR_GIVEN": "rate that the orders in force give at this speed, L/ha; not measured",
    "SPR_NEXT": "seconds to the next change of a valve, where the plan has one",
    "SPR_LITRE": "litres that the orders stand for since the start; not measured",
    "SPR_TANK": "litres left by the ordered flow, once a filling was reported; an estimate",
    "SPR_LIVE": "1, at 10 Hz, only while a plan may open a valve: the watchdog's sign of life",
}


def _table(head: str, rows: list[str]) -> str:
    columns = head.count("|") + 1
    return f"| {head} |\n|{'---|' * columns}\n" + "\n".join(rows) + "\n"


def _name(number: int) -> str:
    return str(mavlink.enums["MAV_CMD"][number].name)


def _message(number: int) -> str:
    return str(mavlink.mavlink_map[number].msgname)


def _sent() -> list[str]:
    """Return the names of the messages that the encoder makes."""
    names = set(re.findall(r"_mav\.(\w+)_encode", inspect.getsource(encode)))
    return sorted(name.upper() for name in names)


def _spr_names() -> list[str]:
    found: dict[str, None] = {}
    for node in ast.walk(ast.parse(inspect.getsource(announcer))):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and re.fullmatch(r"SPR_[A-Z]+", node.value):  # type: ignore[attr-defined]
            found[node.value] = None  # type: ignore[attr-defined]
    return list(found)


def page() -> str:
    """Return the page; KeyError for a command, parameter or value that is not described."""
    numbers = sorted(
        value
        for name, value in vars(link_commands).items()
        if name.isupper() and isinstance(value, int) and value in mavlink.enums["MAV_CMD"]
        and value not in link_commands.OWN_MESSAGES and value > 3
    )  # fmt: skip
    commands = [f"| `{_name(number)}` | {number} | {COMMANDS[number]} |" for number in numbers]
    known = known_parameters(dict.fromkeys([key for key, _, _ in SETTINGS.values()], 0.0))
    parameters = []
    for one in known:
        text = (
            PARAMETERS[one.name] if one.setting is None else f"`{one.setting}`, from the next start"
        )
        when = "disarmed" if one.is_kept else "always"
        parameters.append(f"| `{one.name}` | {one.low:g} to {one.high:g} | {text} | {when} |")
    values = [f"| `{name}` | {VALUES[name]} |" for name in _spr_names()]
    vehicle = ", ".join(_message(number) for number in sorted(codec.FROM_VEHICLE))
    anyone = ", ".join(_message(number) for number in sorted(codec.FROM_ANYONE))
    return "\n".join(
        [
            INTRODUCTION,
            "## Commands\n\nCOMMAND_LONG or COMMAND_INT to this component. Any other command is answered "
            "UNSUPPORTED. A stop is also taken if it is sent to everyone; an enable never is.\n",
            _table("Command | Number | What it does", commands),
            "## Parameters\n\nAny ground station can read and set them (classic protocol, REAL32). A value "
            "that is kept outlives a restart, in `parameters.json` in `link.state_folder`.\n",
            _table("Name | Range | Meaning | Set while", parameters),
            "## Values for a ground station\n\nNAMED_VALUE_FLOAT, once a second unless said otherwise.\n",
            _table("Name | Meaning", values),
            "## Messages\n",
            f"**Heard from the vehicle's autopilot:** {vehicle}.\n",
            f"**Heard from anyone:** {anyone}.\n",
            f"**Sent:** {', '.join(_sent())}.\n",
        ]
    )

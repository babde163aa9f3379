"""`vrspray config new`: six questions, and a commented configuration that `config check` passes."""

from __future__ import annotations

import io
import json
import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from companion.atomic_write import write_atomically
from companion.cli.answer import problem_line, problem_object
from companion.cli.app import find_command, load_command
from companion.commands import registered
from companion.config import Config, load
from companion.config.rules import SWATH_TOLERANCE
from companion.errors import ConfigError, MapError, Problem, VrsprayError

Ask = Callable[[str, str], str]
AUTOPILOTS = ("ardupilot", "px4")
OUTPUTS = ("servo", "gpio")
GUARDS = ("script", "board", "none")
# For PX4 until somebody has said that the board is there.
UNSAID = ""
_GUARD_LINES = {
    "script": """\
# ArduPilot's watchdog script closes the valves when this computer or its link is lost; install it
# (deploy/ardupilot). Without it nothing is sprayed.
guard = "auto"
""",
    "board": """\
# The driver board closes its valve when the signal stops moving, as when this computer or its link
# is lost; test it. The signal moves by dither_us.
guard = "auto"
dither_us = 8
""",
    UNSAID: """\
# PX4 has no watchdog script: fit a driver board, test it, and add dither_us = 8. Until then nothing
# is sprayed.
guard = "auto"
""",
    "none": """\
# Nothing closes the valves when this computer or its link is lost: keep a hand at the pump switch.
guard = "none-on-power-loss"
""",
}
UNITS = ("L/ha", "gal/ac", "mL/m2", "L/mu")
VALVES_MAX = 64
_FROM_PROFILE = """\
# Written by `vrspray config new` from a profile. Its figures and the lines below are of the sprayer
# that the profile was made for: check each against yours, and measure yours."""
# ISO 10625: the first two digits of a size, and tenths behind them, are the flow in tenths of a US
# gallon a minute at 40 psi (2.76 bar): 015 is 1.5.
_ISO_L_MIN, _ISO_BAR = 0.37854, 2.758
# How many, and how far apart: 6 1.0; 8, 0.5; 8 0,5; 8 x 0,5 m.
_VALVES = re.compile(r"(\d+)\s*[ ,;x]\s*(\d*[.,]?\d+)\s*m?")
_ISO = re.compile(r"(iso ?)?(\d{1,2})\.?(\d*)(?: ?(?:at|@) ?(\d+(?:\.\d+)?) ?(bar|psi|kpa))?")
_BAR = {"bar": 1.0, "psi": 0.0689476, "kpa": 0.01}
FLOWS = "write L/min (0.8), or an ISO size with its pressure (03 at 3 bar, at 40 psi, at 300 kPa)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """What is asked of a sprayer. `nozzle_l_min` is of all nozzles of one valve, fully open.

    `bucket` names the file of a bucket test, and `curves` holds its nozzle sets: valves, duty and
    flow_l_min, which stand instead of that flow.
    """

    autopilot: Literal["ardupilot", "px4"] = "ardupilot"
    link: str = "serial:/dev/serial0:921600"
    output: Literal["servo", "gpio"] = "servo"
    first_channel: int = 9
    guard: str = "script"
    valves: int = 6
    spacing_m: float = 1.0
    nozzle_l_min: float = 0.8
    bucket: str = ""
    curves: tuple[Mapping[str, Any], ...] = ()
    map_file: str = ""
    unit: str = ""
    swath_m: float | None = None

    @property
    def width_m(self) -> float:
        """Return the width of a pass."""
        return self.valves * self.spacing_m if self.swath_m is None else self.swath_m


def ask_all(
    answers: Answers,
    ask: Ask,
    complain: Callable[[str], None],
    check: Callable[[Answers], None] = lambda _: None,
) -> Answers:
    """Return the answers after six questions; one whose answer cannot be is asked again.

    `ask` gets a question and its default; `complain` is told what is wrong with an answer; `check`
    raises for answers that make no configuration. The first two are tried with a single valve.
    """

    def asked(
        question: str, default: str, take: Callable[[Answers, str], Answers], so_far: Answers
    ) -> Answers:
        while True:
            try:
                found = take(so_far, ask(question, default))
                is_early = question.startswith(("1", "2"))
                check(replace(found, valves=1, swath_m=None) if is_early else found)
                return found
            except VrsprayError as error:
                complain(str(error))

    was = answers
    answers = asked(
        "1. Autopilot and its link", f"{was.autopilot} {was.link}", _with_autopilot, answers
    )
    answers = asked(
        "2. Valves on: servo or gpio, the first output, and of servo what closes them when this "
        "computer or its link is lost: script (ArduPilot's watchdog), board (sees alive dither), "
        "or none",
        " ".join(_outputs(answers)),
        _with_outputs,
        answers,
    )
    answers = asked(
        "3. How many valves, and metres between them",
        f"{answers.valves} {answers.spacing_m:g}",
        _with_valves,
        answers,
    )
    answers = asked(
        "4. Flow of one valve, fully open: L/min, an ISO size as in '03 at 3 bar', or the CSV file "
        "of a bucket test",
        answers.bucket or f"{answers.nozzle_l_min:g}",
        _with_flow,
        answers,
    )
    answers = asked(
        "5. Prescription map, if there is one, and its unit if the map does not say it, as in "
        "field.geojson L/ha",
        f"{answers.map_file} {answers.unit}".strip(),
        lambda so_far, text: _with_its_unit(_with_map(so_far, text)),
        answers,
    )
    return asked("6. Swath in metres", f"{answers.width_m:g}", _with_swath, answers)


def answers_of(
    *,
    autopilot: str,
    output: str,
    valves: str,
    nozzle: str,
    map_file: str,
    unit: str,
    swath_m: float | None,
) -> Answers:
    """Return the answers of the command line; a ConfigError for one that cannot be."""
    answers = _with_autopilot(Answers(map_file=map_file, unit=known_unit(unit)), autopilot)
    answers = _with_flow(_with_valves(_with_outputs(answers, output), valves), nozzle)
    return answers if swath_m is None else _with_swath(answers, f"{swath_m}")


def known_unit(unit: str) -> str:
    """Return a unit of rates as it is, or none; a ConfigError for another."""
    if unit and unit not in UNITS:
        raise ConfigError(f"{unit!r}: not a unit of rates; write one of {', '.join(UNITS)}")
    return unit


def nozzle_flow(text: str) -> float:
    """Return the flow of a valve, of a figure in L/min or of an ISO size at a pressure.

    >>> nozzle_flow("0,8 L/min"), round(nozzle_flow("03 at 3 bar"), 3)
    (0.8, 1.184)
    """
    plain = " ".join(text.lower().replace(",", ".").split()).removesuffix("l/min").strip()
    size = _ISO.fullmatch(plain)
    is_size = size is not None and bool(size[1] or size[4] or re.match(r"0\d", plain))
    if size is None or not is_size:
        return _number(plain, "flow of one valve", 0.01, 100.0, FLOWS)
    if size[4] is None:
        raise ConfigError(f"{text}: an ISO size says no flow without its pressure; {FLOWS}")
    bar = float(size[4]) * _BAR[size[5]]
    flow = float(f"{size[2]}.{size[3]}") * _ISO_L_MIN * math.sqrt(bar / _ISO_BAR)
    return _number(f"{flow}", "flow of one valve", 0.01, 100.0, FLOWS)


def bucket_curves(csv: str) -> tuple[Mapping[str, Any], ...]:
    """Return the nozzle sets that `vrspray calibrate flow` fits to a bucket test."""
    command = find_command("calibrate")
    if command is None:
        raise ConfigError(f"{csv}: `vrspray calibrate` is not installed here; write a flow instead")
    told = io.StringIO()
    with redirect_stdout(told):
        load_command("calibrate", command).main(["flow", csv, "--json"], standalone_mode=False)
    result = json.loads(told.getvalue())
    if "sets" not in result:
        raise ConfigError(f"{csv}: was measured by pulse widths, of a pump; see examples/pump")
    return tuple(result["sets"])


def _with_autopilot(answers: Answers, text: str) -> Answers:
    words = text.split()
    name, *rest = words or [""]
    name = name.lower()
    if name not in AUTOPILOTS or len(rest) > 1:
        raise ConfigError(
            f"{' '.join(words)!r}: not an autopilot; write ardupilot or px4, and then its link, "
            "such as serial:/dev/serial0:921600"
        )
    link = rest[0] if rest else answers.link
    is_px4 = name == "px4"  # which counts actuators from 1 where ArduPilot counts outputs
    return replace(
        answers,
        autopilot="px4" if is_px4 else "ardupilot",
        link=link,
        first_channel=1 if is_px4 else 9,
        guard=UNSAID if is_px4 else "script",
    )


def _with_outputs(answers: Answers, text: str) -> Answers:
    words = text.split()
    kind, *rest = words or [""]
    is_px4 = answers.autopilot == "px4"
    guards = (UNSAID, "board", "none") if is_px4 else GUARDS
    guard = rest.pop() if rest and rest[-1] in GUARDS else guards[0]
    if kind not in OUTPUTS or len(rest) > 1:
        raise ConfigError(f"{' '.join(words)!r}: not an output; write servo 9, or gpio 5")
    if guard not in guards:
        raise ConfigError(f"{guard}: PX4 has no watchdog script; write board, or none")
    default = 5 if kind == "gpio" else 1 if is_px4 else 9
    first = int(_number(rest[0], "first output", 0, 1023)) if rest else default
    output: Literal["servo", "gpio"] = "gpio" if kind == "gpio" else "servo"
    return replace(answers, output=output, first_channel=first, guard=guard)


def _outputs(answers: Answers) -> list[str]:
    words = [answers.output, str(answers.first_channel)]
    return [*words, answers.guard] if answers.output == "servo" and answers.guard else words


def _with_valves(answers: Answers, text: str) -> Answers:
    found = _VALVES.fullmatch(text.strip().lower())
    if found is None:
        raise ConfigError(
            f"{text.strip()!r}: write a whole number and metres, such as 6 1.0 or 8 0,5"
        )
    count = _number(found[1], "number of valves", 1, VALVES_MAX)
    spacing_m = _number(found[2], "spacing", 0.05, 50.0)
    return replace(answers, valves=int(count), spacing_m=spacing_m, swath_m=None)


def _with_flow(answers: Answers, text: str) -> Answers:
    if Path(text).suffix.lower() == ".csv":
        return replace(answers, bucket=text, curves=bucket_curves(text))
    return replace(answers, nozzle_l_min=nozzle_flow(text), bucket="", curves=())


def _with_map(answers: Answers, text: str) -> Answers:
    name, _, unit = text.rpartition(" ")
    if not name:
        name, unit = unit, answers.unit
    elif unit not in UNITS:  # a blank within the name
        name, unit = text, answers.unit
    if name and not Path(name).exists():
        raise ConfigError(f"{name}: there is no such file; give a map, or nothing")
    return replace(answers, map_file=name, unit=unit)


def _with_its_unit(answers: Answers) -> Answers:
    """Return the answers; a ConfigError where the map needs a unit, as long as one can be given."""
    command = find_command("map") if answers.map_file else None
    if command is None:
        return answers
    words = ["check", answers.map_file, *(["--unit", answers.unit] if answers.unit else [])]
    try:
        with redirect_stdout(io.StringIO()):
            load_command("map", command).main([*words, "--json"], standalone_mode=False)
    except MapError as error:
        if error.code == "no-unit":
            raise ConfigError(
                f"{answers.map_file}: does not say the unit of its rates; write it behind the "
                f"name, one of {', '.join(UNITS)}"
            ) from error
    return answers


def _with_swath(answers: Answers, text: str) -> Answers:
    swath_m = _number(text.strip().lower().removesuffix("m"), "swath", 0.1, 100.0)
    wide_m = answers.valves * answers.spacing_m
    # Strips of another width than the spacing would lie over each other, or apart.
    if answers.valves > 1 and abs(swath_m - wide_m) > SWATH_TOLERANCE * wide_m:
        raise ConfigError(
            f"swath {swath_m:g}: {answers.valves} valves {answers.spacing_m:g} m apart cover "
            f"{wide_m:g} m; write that, or another spacing"
        )
    return replace(answers, swath_m=swath_m)


def _number(text: str, what: str, least: float, most: float, forms: str = "") -> float:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise ConfigError(
            f"{what} {text!r}: {forms or f'write a number from {least:g} to {most:g}'}"
        )
    return value


def text_of(answers: Answers, *, map_name: str = "") -> str:
    """Return the configuration as text; `map_name` is that of the map, seen from the file."""
    parts = [_HEAD, _link(answers)]
    if map_name:
        parts.append(_prescription(map_name, answers.unit))
    parts += [_boom(answers), _flows(answers), _LAG, _output(answers), _safety(answers)]
    parts += [_mission(answers), _JOURNAL]
    return "\n".join(part.strip() + "\n" for part in parts)


_HEAD = """
# Written by `vrspray config new`. After every change: vrspray config check, with its name
# All keys: vrspray config schema, or "Configuration keys" in the documentation.
# What is marked MEASURE is a guess until you have.

version = 1
"""
_PRESCRIPTION = """
# The map. If it has several columns of rates, or does not say its unit, write rate_field and unit.
[prescription]
file = {file}
{unit}
"""
_LAG = """
# MEASURE: how late the spray is. These are those of an example, and `vrspray doctor` says so until
# you have measured yours: with a flow meter `vrspray calibrate lag`, without one
# `vrspray calibrate lag-marks`; add --write to have the figures put in here.
[lag]
on_s = 0.10
off_s = 0.08
up_s = 0.10
down_s = 0.10
on_start_s = 0.05
off_end_s = 0.15
output_s = 0.02
position_s = 0.0
"""
_JOURNAL = """
# One file a flight, in this folder beside the configuration.
[journal]
folder = "flights"
"""


def _link(answers: Answers) -> str:
    return (
        "# The flight controller: serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT or\n"
        f"# tcp:HOST:PORT.\n[link]\nurl = {_quoted(answers.link)}\n"
    )


def _prescription(map_name: str, unit: str) -> str:
    unit_line = f"unit = {_quoted(unit)}" if unit else ""
    return _PRESCRIPTION.format(file=_quoted(map_name), unit=unit_line).strip()


def _boom(answers: Answers) -> str:
    lines = [
        "# Width of a pass, and the height above the crop.",
        "[boom]",
        f"width_m = {answers.width_m:g}",
        "height_m = 3.5",
        "",
        "# The valves from left to right; right_m: middle of its strip, right of the aircraft.",
    ]
    strip_m = answers.width_m / answers.valves
    for number in range(answers.valves):
        right_m = round((number - 0.5 * (answers.valves - 1)) * strip_m, 4)
        lines += ["[[valve]]", f'name = "{number + 1}"', f"right_m = {right_m or 0.0}"]
        lines += [f"channel = {answers.first_channel + number}", ""]
    return "\n".join(lines)


def _flows(answers: Answers) -> str:
    every = [str(number + 1) for number in range(answers.valves)]
    duty = (0.2, 0.4, 0.6, 0.8, 1.0)
    guess = {
        "valves": every,
        "duty": duty,
        "flow_l_min": [each * answers.valves * answers.nozzle_l_min for each in duty],
    }
    if answers.curves:
        source = f"# Flow of all valves of a set together: the bucket test in {answers.bucket}."
    else:
        source = f"""# MEASURE: flow of all valves together at each duty, here in proportion to it,
# {answers.nozzle_l_min:.3g} L/min a valve. A bucket test:
# vrspray calibrate flow bucket.csv --config FILE --write"""
    sets = "\n".join(_nozzle_set(each, every) for each in answers.curves or (guess,))
    return f"""
[pwm]
frequency_hz = 11.0
duty_min = 0.2
duty_max = 0.9
valve = "normally-closed"

{source}
{sets}
"""


def _nozzle_set(curve: Mapping[str, Any], every: list[str]) -> str:
    names = ", ".join(_quoted(name) for name in curve["valves"] or every)
    return f"""[[nozzle_set]]
valves = [{names}]
duty = [{", ".join(f"{each:g}" for each in curve["duty"])}]
flow_l_min = [{", ".join(f"{each:.3f}" for each in curve["flow_l_min"])}]
"""


def _output(answers: Answers) -> str:
    if answers.output == "gpio":
        return """
# Valves on lines of this computer; `chip` is the one that `gpiodetect` names.
[output]
kind = "gpio"
chip = "gpiochip0"
"""
    return f"""
# Valves on outputs of the flight controller: pulse of closed and of fully open, as the driver
# board takes them.
[output]
kind = "servo"
closed_us = 1000
full_us = 2000
{_GUARD_LINES[answers.guard]}"""


def _safety(answers: Answers) -> str:
    mode = "MISSION" if answers.autopilot == "px4" else "AUTO"
    return f"""
# What must hold before a valve opens. To enable by an RC switch too: add "rc", and
# rc_channel = 7; from the operator's page: "web".
[safety]
enable_by = ["command"]
modes = ["{mode}"]
speed_min_m_s = 1.0
speed_max_m_s = 12.0
height_min_m = 1.0
height_max_m = 10.0
wind_max_m_s = 6.0
fix = "rtk-float"
# True only with a relay that cuts the pump when this computer fails: fit one.
pump_cutoff = false
"""


def _mission(answers: Answers) -> str:
    return f"""
# For `vrspray plan`. After planning, name its lines: lines = "field.lines.geojson"
[mission]
autopilot = "{answers.autopilot}"
swath_width_m = {answers.width_m:g}
speed_m_s = 5.0
height_m = 3.5
tank_l = 40.0
reserve_l = 1.0
rate_l_ha = 20.0
"""


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def read_profile(name: str) -> str:
    """Return the text of a profile: a file, or one of the examples where they are installed."""
    path = Path(name)
    if path.suffix != ".toml":
        known = {each.stem: each for folder in _folders() for each in folder.glob("*.toml")}
        if name not in known:
            names = ", ".join(sorted(known)) or "none installed here"
            raise ConfigError(f"--profile {name}: not known; write a .toml file, or one of {names}")
        path = known[name]
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--profile {path}: cannot be read; give a configuration file") from error


def _folders() -> list[Path]:
    """Return where profiles are: in the wheel beside the simulation, or in the source tree."""
    told = registered().get("sitl")
    found = None if told is None else find_spec(told.module.partition(".")[0])
    packages = [] if found is None else list(found.submodule_search_locations or ())
    places = [Path(each) / "examples" for each in packages]
    places += [Path(each).parent / "examples" for each in packages]
    return [place / "profiles" for place in places if (place / "profiles").is_dir()]


def profile_text(text: str, *, map_name: str, unit: str = "") -> str:
    """Return a profile with another map; without one, for `plan` and without a map.

    What a profile says of its wiring stays; it is of the sprayer that the profile was made for.
    """
    text = f"{_FROM_PROFILE}\n#\n{text}"
    table = f"{_prescription(map_name, unit)}\n\n" if map_name else ""
    found = re.sub(
        r"(?m)(^#[^\n]*\n)*^\[prescription\]\n(?:(?!\[)[^\n]*\n)*", lambda _: table, text, count=1
    )
    return found if table == "" or "[prescription]" in found else f"{found}\n{table}"


def write_checked(
    out: Path, text: str, problems_of: Callable[[Config], list[Problem]]
) -> tuple[Config, list[Problem]]:
    """Write a configuration that `config check` accepts, with what it warns of.

    Of any other nothing is left.

    Raises:
        ConfigError: where it cannot be written, or would be refused.
    """
    draft = out.with_name(f".{out.name}.{os.getpid()}.toml")
    try:
        write_atomically(draft, text.encode())
        found = problems_of(load(draft))
        wrong = [problem for problem in found if problem.severity == "error"]
        if wrong:
            line = problem_line(problem_object(wrong[0])).removeprefix("error: ")
            raise ConfigError(f"{line}; {out} is not written", problems=wrong)
        draft.replace(out)
        return load(out), found
    except OSError as error:
        reason = (error.strerror or "cannot be written").lower()
        raise ConfigError(f"{out}: {reason}; give another file") from error
    except ConfigError as error:
        text = str(error).replace(str(draft), str(out))
        raise ConfigError(text, problems=error.problems) from error
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def map_seen_from(out: Path, map_file: str) -> str:
    """Return the name of the map as the configuration has it, relative to its own folder."""
    return os.path.relpath(map_file, out.parent) if map_file else ""

"""The program: help, usage, how it ends, `config`, and what `run` is put together of."""

from __future__ import annotations

import asyncio
import importlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer

from companion.cli.app import COMMANDS, _interrupt, app, execute, load_command, main
from companion.cli.run import build_executor, component_options
from companion.commands import Command, all_registered
from companion.config import load
from companion.core.types import SprayPlan
from companion.errors import ActuatorError, LinkError, VrsprayError
from companion.link.vehicle_link import VehicleLink
from companion.output.gpio import GpioExecutor
from companion.output.servo import ServoExecutor
from companion.output.timed import DryRunExecutor
from tests.companion.wire_peer import free_port, heard
from tests.json_answers import CONFIG, MAP, Captured, run_json
from tests.unguarded import unguarded

# ------------------------------------------------------------------------------- the program itself


def test_help_lists_every_command_without_importing_any(capsys: Captured) -> None:
    script = (
        "import sys; from companion.cli.app import execute; code = execute(['--help']);"
        "heavy = {'numpy', 'shapely', 'pyproj', 'companion.config', 'companion.core.types'};"
        "print(sorted(heavy & set(sys.modules)), code, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr.strip() == "[] 0"
    for name, place in {**COMMANDS, **all_registered()}.items():
        assert f"  {name} " in done.stdout
        assert place.help in done.stdout


# What most flights do without; each is loaded when a flight that has it is put together.
NOT_OF_EVERY_FLIGHT = (
    "companion.cli.sensor_parts", "companion.cli.web_parts", "companion.web",
    "companion.config.motor_rules",
    "companion.core.options.liquid_faults", "companion.flight_map.child",
    "companion.link.signing", "companion.output.engine",
    "companion.output.gpio", "companion.output.hardware_pwm", "companion.journal.continuing",
    "companion.journal.leaf_page", "companion.journal.log", "companion.journal.reader",
    "companion.journal.folder", "companion.journal.folder", "companion.sensors",
)  # fmt: skip


def test_a_run_loads_nothing_of_the_office_and_of_options_what_it_has() -> None:
    script = (
        "import sys; import companion.cli.run; ours = {'analysis', 'missions', 'sitl'};"
        "print(sorted(ours & {name.partition('.')[0] for name in sys.modules}),"
        f"sorted(set({NOT_OF_EVERY_FLIGHT!r}) & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "[] []\n"


def test_module_runs_as_the_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "companion", "--version"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.startswith("vrspray ")


def test_main_leaves_with_the_exit_code(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as left:
        main(["map", "check", "none.shp"])
    assert left.value.code == 2


@pytest.mark.parametrize(
    "arguments",
    [["fly"], ["map", "rate"], ["config", "check"], ["run"], ["--nope"]],
    ids=" ".join,
)
def test_wrong_usage_is_one_line_and_exit_2(arguments: list[str], capsys: Captured) -> None:
    assert execute(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("name", ["", "map", "sitl", "calibrate", "flights", "config", "service"])
def test_command_alone_shows_its_help_and_is_wrong_usage(name: str, capsys: Captured) -> None:
    assert execute(name.split()) == 2
    captured = capsys.readouterr()
    assert captured.out.startswith(f"Usage: vrspray {name}".rstrip())
    assert "Commands:" in captured.out
    assert captured.err == ""


# A frame around its options is Typer's other style.
@pytest.mark.parametrize("name", ["", "sitl", "sitl serve", "map check", "calibrate flow", "run"])
def test_short_help_is_the_help_and_has_one_style(name: str, capsys: Captured) -> None:
    assert execute([*name.split(), "-h"]) == 0
    short = capsys.readouterr().out
    assert execute([*name.split(), "--help"]) == 0
    assert capsys.readouterr().out == short
    assert short.startswith("Usage: vrspray")
    assert "\nOptions:\n" in short


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("vrspray ca", ["calibrate", "campaign"]),
        ("vrspray map conv", ["convert"]),
        ("vrspray ru", ["run"]),
    ],
)
def test_shell_completes_commands(words: str, offered: list[str]) -> None:
    asked = {
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
        "_VRSPRAY_COMPLETE": "complete_bash",
    }
    done = subprocess.run(
        [sys.executable, "-m", "companion"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.split() == offered
    assert done.stderr == ""


def test_completion_is_installed_for_a_shell(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "companion", "--install-completion", "bash"],
        env={
            **os.environ,
            "HOME": str(tmp_path),
            "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    script = tmp_path / ".bash_completions" / "vrspray.sh"
    assert "_VRSPRAY_COMPLETE=complete_bash" in script.read_text()
    assert str(script) in (tmp_path / ".bashrc").read_text()


@pytest.mark.parametrize("arguments", [["--help"], ["config", "show", CONFIG]], ids=" ".join)
def test_full_disk_is_one_line(arguments: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "companion", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    assert (done.returncode, done.stderr) == (
        1,
        "error: output: no space left; free some, or write elsewhere\n",
    )


def test_interrupt_while_the_program_loads_is_one_line() -> None:
    script = (
        "import os, signal, sys\n"
        "class Press:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'typer': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Press())\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from companion.__main__ import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_interrupt_in_the_middle_of_an_import_waits_for_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A library makes another error of it, as here one that nobody catches."""
    (tmp_path / "half_imported.py").write_text(
        "import os, signal, time\n"
        "try:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(0.1)\n"
        "except KeyboardInterrupt:\n"
        "    raise ImportError('half of it') from None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            importlib.import_module("half_imported")
            time.sleep(30.0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert "half_imported" in sys.modules


def test_wrong_usage_with_json_is_one_object(capsys: Captured) -> None:
    code, found = run_json(capsys, "map", "check", "--unknown-option", MAP)
    assert code == 2
    assert "--unknown-option" in found["error"]


def raise_interrupt() -> None:
    raise KeyboardInterrupt


def raise_refusal() -> None:
    raise LinkError("port 14550 is in use;\nstop the other program")


def raise_failure() -> None:
    raise ActuatorError("no answer")


def return_one() -> int:
    return 1


@pytest.mark.parametrize(
    ("function", "code", "text"),
    [
        ("raise_interrupt", 130, "interrupted"),
        ("raise_refusal", 2, "port 14550 is in use; stop the other program"),
        ("raise_failure", 1, "no answer"),
    ],
)
def test_every_end_has_its_exit_code_and_one_line(
    function: str, code: int, text: str, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "own_commands", sys.modules[__name__])
    monkeypatch.setitem(
        COMMANDS, "trial", Command(target=f"own_commands:{function}", help="A trial.")
    )
    assert execute(["trial"]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.removeprefix("error: ") == text + "\n"


def test_number_that_a_command_returns_is_its_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "own_commands", sys.modules[__name__])
    monkeypatch.setitem(
        COMMANDS, "trial", Command(target="own_commands:return_one", help="A trial.")
    )
    assert execute(["trial"]) == 1


def test_command_that_is_not_installed_says_so() -> None:
    with pytest.raises(VrsprayError, match="no_such_package is not installed; add it: "):
        load_command("fly", Command(target="no_such_package:fly", help="Fly."))


@pytest.mark.parametrize("name", ["run", "config", "map", "replay"])
def test_command_has_help_with_an_example(name: str, capsys: Captured) -> None:
    assert execute([name, "--help"]) == 0
    assert f"vrspray {name}" in capsys.readouterr().out.partition("Example:")[2]


def examples_of(command: Any) -> Iterator[str]:
    for text in (command.epilog or "", command.help or ""):
        for found in re.findall(r"Example: (.*?)(?=Example:|\n\n|$)", text, re.DOTALL):
            yield " ".join(found.split())
    if hasattr(command, "list_commands"):
        context = command.make_context("vrspray", [], resilient_parsing=True)
        for name in command.list_commands(context):
            yield from examples_of(command.get_command(context, name))


def test_every_example_of_the_help_has_all_that_its_command_wants() -> None:
    whole = typer.main.get_command(app)
    examples = list(examples_of(whole))
    assert len(examples) > 60
    for example in examples:
        words = shlex.split(example.removeprefix("sudo ").partition(" > ")[0])
        command, context = whole, None
        args = words[1:]
        while hasattr(command, "list_commands"):
            context = command.make_context("x", list(args), parent=context)
            _, command, args = command.resolve_command(
                context, [*context._protected_args, *context.args]
            )
        command.make_context("x", list(args), parent=context)  # or says what is missing


@pytest.mark.parametrize("name", ["config check", "config show", "config schema"])
@pytest.mark.parametrize("option", ["--json", "Example: vrspray"])
def test_command_of_config_has_json_and_an_example(
    name: str, option: str, capsys: Captured
) -> None:
    assert execute([*name.split(), "--help"]) == 0
    assert option in capsys.readouterr().out


# ------------------------------------------------------------------------------------------ config


def test_config_check_accepts_the_example(capsys: Captured) -> None:
    code, found = run_json(capsys, "config", "check", CONFIG)
    everywhere, guarded, unmetered = found.pop("notes")
    assert (code, found) == (0, {"ok": True, "path": CONFIG, "problems": []})
    assert "the drone sprays the whole map" in everywhere
    assert "watchdog script is seen" in guarded
    assert "calibrate lag` needs a flow meter" in unmetered


def test_config_check_writes_nothing(tmp_path: Path, capsys: Captured) -> None:
    folder = Path(shutil.copytree(Path(CONFIG).parent, tmp_path / "field"))
    shutil.rmtree(folder / "state", ignore_errors=True)
    before = sorted(folder.rglob("*"))
    assert execute(["config", "check", str(folder / "config.toml")]) == 0
    capsys.readouterr()
    assert sorted(folder.rglob("*")) == before


def test_config_check_prints_every_problem(capsys: Captured) -> None:
    given = ["lag.on_s=-1", "valve[0].channel=0.5", "boom.widht_m=6"]
    overrides = [part for one in given for part in ("--set", one)]
    code, found = run_json(capsys, "config", "check", CONFIG, *overrides)
    assert (code, found["ok"]) == (2, False)
    keys = ["boom.widht_m", "valve[0].channel", "lag.on_s"]
    assert [problem["where"] for problem in found["problems"]] == keys
    assert "did you mean boom.width_m?" in found["problems"][0]["fix"]
    assert execute(["config", "check", CONFIG, *overrides]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["error"] * 3 + [CONFIG]
    assert all(key in line for key, line in zip(keys, lines, strict=False))


def test_config_check_lists_a_map_that_is_missing_beside_all_else(capsys: Captured) -> None:
    given = ["prescription.file=none.shp", "mission.swath_width_m=9", 'safety.modes=["ATUO"]']
    overrides = [part for one in given for part in ("--set", one)]
    code, found = run_json(capsys, "config", "check", CONFIG, *overrides)
    assert code == 2
    assert [problem["where"] for problem in found["problems"][:2]] == [
        "mission.swath_width_m",
        "safety.modes",
    ]
    assert "none.shp" in str(found["problems"][2])


def test_config_check_refuses_a_swath_that_is_not_the_boom(capsys: Captured) -> None:
    code, found = run_json(capsys, "config", "check", CONFIG, "--set", "mission.swath_width_m=5.8")
    assert code == 2
    assert not found["ok"]
    (problem,) = found["problems"]
    assert (problem["severity"], problem["where"]) == ("error", "mission.swath_width_m")


def test_config_check_warns_of_what_it_cannot_deliver_or_do(capsys: Captured) -> None:
    overrides = ["--set", "mission.speed_m_s=8", "--set", "flow_trim.enabled=true"]
    code, found = run_json(capsys, "config", "check", CONFIG, *overrides)
    assert code == 0
    assert [problem["code"] for problem in found["problems"]] == ["no-effect", "rate-too-high"]


def test_config_check_refuses_a_wrong_file_in_one_line(capsys: Captured) -> None:
    code, found = run_json(capsys, "config", "check", CONFIG, "--set", "lag.onn_s=1")
    assert code == 2
    assert "did you mean lag.on_s?" in found["error"]


def test_config_show_says_where_each_setting_comes_from(capsys: Captured) -> None:
    assert execute(["config", "show", CONFIG, "--set", "lag.on_s=0.12"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "lag.on_s = 0.12  # override" in lines
    assert "boom.height_m = 3.5  # file" in lines
    assert "prescription.unit = (not set)  # default" in lines
    code, found = run_json(capsys, "config", "show", CONFIG)
    assert code == 0
    assert found["settings"]["boom.height_m"] == {"value": 3.5, "origin": "file"}


def test_config_schema_knows_the_tables(capsys: Captured) -> None:
    code, found = run_json(capsys, "config", "schema")
    assert code == 0
    assert {"boom", "valve", "nozzle_set", "lag"} <= set(found["required"])


# --------------------------------------------------------------------------------------------- run


def test_link_gets_what_the_configuration_says() -> None:
    overrides = ["link.system_id=7", "link.component_id=192", "link.position_rate_hz=12"]
    options = component_options(load(Path(CONFIG), overrides=overrides))
    assert (options.system_id, options.component_id, options.position_rate_hz) == (7, 192, 12)


def test_outputs_are_those_of_the_configuration() -> None:
    orders: list[tuple[int, int]] = []

    class Link(VehicleLink):
        def order(self, channel: int, pulse_us: int) -> bool:
            orders.append((channel, pulse_us))
            return True

    overrides = ["output.closed_us=1100", "output.full_us=1900", "valve[0].channel=21"]
    config = load(Path(CONFIG), overrides=overrides)
    link = Link(config.link.url, component_options(config))
    executor = unguarded(build_executor(config, link))
    assert isinstance(executor, ServoExecutor)

    async def open_all() -> None:
        await executor.start()
        now_s = asyncio.get_running_loop().time()
        executor.submit(
            SprayPlan(
                sequence=1, issued_s=now_s, duty=(1.0,) * 6, changes=(), lease_until_s=now_s + 1.0
            )
        )
        await executor.stop()

    asyncio.run(open_all())
    channels = (21, 10, 11, 12, 13, 14)
    assert orders[:6] == [(channel, 1100) for channel in channels]
    assert orders[6:12] == [(channel, 1900) for channel in channels]
    assert orders[12:18] == [(channel, 1100) for channel in channels]


def test_refusal_of_an_order_reaches_the_executor() -> None:
    config = load(Path(CONFIG))
    link = VehicleLink(config.link.url, component_options(config))
    executor = build_executor(config, link)
    assert link.component.on_order_ack is not None
    link.component.on_order_ack(4)
    assert executor.fault is not None


def test_dry_run_has_no_outputs_and_gpio_has_an_engine() -> None:
    dry = load(Path(CONFIG), overrides=["output.kind=none"])
    link = VehicleLink(dry.link.url, component_options(dry))
    assert isinstance(build_executor(dry, link), DryRunExecutor)
    gpio = load(Path(CONFIG), overrides=["output.kind=gpio"])
    assert isinstance(build_executor(gpio, link), GpioExecutor)


def run_arguments(folder: Path, port: int) -> list[str]:
    settings = [f"journal.folder={folder}", f"link.url=udpin:127.0.0.1:{port}"]
    return ["run", "--config", CONFIG, *(part for one in settings for part in ("--set", one))]


def test_run_whose_link_never_opened_leaves_no_journal(capsys: Captured, tmp_path: Path) -> None:
    words = ["--set", "link.url=serial:/dev/none-of-ours:57600", "--duration-s", "0.2"]
    code, found = run_json(capsys, *run_arguments(tmp_path, 0), *words)
    assert (code, found["journal"]) == (0, None)
    assert not list(tmp_path.glob("*.gpkg*"))


def test_run_that_heard_nobody_leaves_no_journal(capsys: Captured, tmp_path: Path) -> None:
    code, found = run_json(capsys, *run_arguments(tmp_path, 0), "--duration-s", "0.2")
    assert (code, found["journal"]) == (0, None)
    assert not list(tmp_path.glob("*.gpkg*"))


def test_run_ends_after_its_duration_and_leaves_a_journal(capsys: Captured, tmp_path: Path) -> None:
    port = free_port()
    with heard(port):
        code, found = run_json(capsys, *run_arguments(tmp_path, port), "--duration-s", "0.5")
    assert code == 0
    assert Path(found["journal"]) == tmp_path / "flight-0001.gpkg"
    code, replayed = run_json(capsys, "replay", found["journal"])
    assert code == 0
    assert replayed["decisions"] > 0
    assert replayed["differences"] == 0


def test_port_in_use_is_one_line_and_exit_2(capsys: Captured, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        code, found = run_json(capsys, *run_arguments(tmp_path, port), "--duration-s", "0.2")
    assert code == 2
    assert f"port {port} is in use" in found["error"]


def every_command(command: Any, above: click.Context | None = None) -> Iterator[click.Context]:
    context = click.Context(command, above, command.name, terminal_width=80, max_content_width=80)
    yield context
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from every_command(command.get_command(context, name), context)


def test_every_command_has_an_example_and_is_told_whole_in_the_list_of_its_group() -> None:
    for context in every_command(typer.main.get_command(app)):
        told = context.get_help()
        assert "Example" in told, context.command_path
        _, _, listed = told.partition("\nCommands:")
        assert not [line for line in listed.splitlines() if line.endswith("...")]

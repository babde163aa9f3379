"""Command line of the simulation: `vrspray sitl serve` and `vrspray sitl fly`."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer, new_app, note


class Board(StrEnum):
    """The driver boards that there are."""

    RESTARTING = "restarting"
    FREE_RUNNING = "free-running"


class FlowLaw(StrEnum):
    """How the sprayer's flow runs between its measured points."""

    SMOOTH = "smooth"
    STRAIGHT = "straight"
    OFFSET = "offset"


class Fidelity(StrEnum):
    """How closely the valves are simulated."""

    AVERAGED = "averaged"
    PULSED = "pulsed"


class OutputPath(StrEnum):
    """By which way the orders reach the valves."""

    GPIO = "gpio"
    SERVO = "servo"


class Corners(StrEnum):
    """How the vehicle flies the corners of its way."""

    STOP = "stop"
    ARDUPILOT = "ardupilot"
    PX4 = "px4"


VEHICLE = "drawn, or flown: as in logs of real flights (gusts, turns, position errors)."
app = new_app(
    help="The simulated flight: stub autopilot and twin.",
    epilog="Example: vrspray sitl serve --autopilot px4",
    no_args_is_help=True,
)


@app.command()
def serve(
    link: Annotated[
        str, typer.Option(help="udpout:, udpin:, tcp: or tcpin:HOST:PORT.")
    ] = "udpout:127.0.0.1:14550",
    station: Annotated[
        list[str] | None,
        typer.Option(metavar="URL", help="One more link, as of a ground station; repeatable."),
    ] = None,
    autopilot: Annotated[str, typer.Option(help="Firmware to behave like: ardupilot or px4.")] = (
        "ardupilot"
    ),
    mission: Annotated[
        Path | None, typer.Option(help="Mission, .plan or .waypoints; default: the example field.")
    ] = None,
    along: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="In place of a mission: a flight really flown."),
    ] = None,
    wait_mission: Annotated[
        bool, typer.Option("--wait-mission", help="Wait for a mission to be uploaded, then fly it.")
    ] = False,
    home: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|LAT,LON",
            help="With --wait-mission: position of the vehicle, or a mission file with its home.",
        ),
    ] = None,
    lines: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Lines of the plan (mission.lines of `run`), to judge the flight by.",
        ),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Scenario: timed faults and vehicle settings (TOML).")
    ] = None,
    speed: Annotated[float, typer.Option(help="Speed of the flight in m/s.")] = 5.0,
    field_config: Annotated[
        Path | None,
        typer.Option(help="Configuration with the wiring of the valves; default: the example."),
    ] = None,
    profile: Annotated[str, typer.Option(help="Sprayer profile.")] = "wang-2024",
    board: Annotated[
        Board, typer.Option(help="Driver board: restarting or free-running.")
    ] = Board.RESTARTING,
    flow_law: Annotated[
        FlowLaw | None,
        typer.Option(help="True flow between measured points; default: the profile's."),
    ] = None,
    vehicle: Annotated[str, typer.Option(help=VEHICLE)] = "drawn",
    gust: Annotated[
        float | None, typer.Option(help="Gusts in m/s; default: the vehicle's.")
    ] = None,
    corners: Annotated[
        Corners | None,
        typer.Option(help="How to fly corners; default: as the autopilot does."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for the true result.")] = None,
    sensors: Annotated[
        Path | None,
        typer.Option(help="Folder of a simulated pressure sensor (iio) for `run`."),
    ] = None,
    wait_s: Annotated[
        float | None, typer.Option(help="How long to wait for a companion; default: no limit.")
    ] = None,
    no_enable: Annotated[bool, typer.Option("--no-enable", help="Do not enable spraying.")] = False,
    ground: Annotated[
        bool, typer.Option("--ground", help="Stay on the ground, disarmed, for ground work.")
    ] = False,
    no_script: Annotated[
        bool, typer.Option("--no-script", help="ArduPilot without its watchdog script.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Serve a simulated autopilot for `vrspray run` to connect to.

    Example: vrspray sitl serve --speed 5 --out truth
    """
    from dataclasses import replace

    from missions.maps.cli.new import parse_mark
    from sitl.serve import ServeOptions
    from sitl.serve_mission import home_of_file

    options = ServeOptions(
        link=link,
        stations=tuple(station or ()),
        autopilot=autopilot,
        mission=mission,
        along=along,
        wait_mission=wait_mission,
        lines=lines,
        scenario=scenario,
        field_config=field_config,
        profile=profile,
        board=board.value,
        flow_law=None if flow_law is None else flow_law.value,
        speed_m_s=speed,
        vehicle=vehicle,
        gust_m_s=gust,
        corners=None if corners is None else corners.value,
        seed=seed,
        out=out,
        sensors=sensors,
        enable=not no_enable,
        script=not no_script,
        ground=ground,
        wait_s=wait_s,
    )
    if home is not None:
        place_deg = home_of_file(home) or parse_mark(home, "--home")
        options = replace(options, place_deg=place_deg)
    result = _run(options)
    answer(result, _served(result), as_json=json)
    raise typer.Exit(0 if result["state"] in ("landed", "stopped") else 1)


@app.command()
def fly(
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the companion; with --along: the example.")
    ] = None,
    mission: Annotated[Path | None, typer.Option(help="Mission, .plan or .waypoints.")] = None,
    along: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="In place of a mission: a log of a flight really flown."),
    ] = None,
    position_rate_hz: Annotated[
        float | None,
        typer.Option(help="With --along: states told a second; default: the configuration's."),
    ] = None,
    flights: Annotated[int, typer.Option(help="With --along: how many, each on its own map.")] = 3,
    scenario: Annotated[Path | None, typer.Option(help="Scenario: timed faults (TOML).")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="Sprayer profile, a name or .toml; default: the nearest in flow."),
    ] = None,
    fidelity: Annotated[
        Fidelity | None,
        typer.Option(help="averaged, or pulsed; default: pulsed with --output servo."),
    ] = None,
    output: Annotated[
        OutputPath | None, typer.Option(help="gpio or servo; default: as the configuration says.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    speed: Annotated[
        float | None, typer.Option(help="m/s on every leg; default: the mission's.")
    ] = None,
    corners: Annotated[
        Corners | None,
        typer.Option(help="How to fly corners; default: as the configured autopilot does."),
    ] = None,
    vehicle: Annotated[str, typer.Option(help=VEHICLE)] = "drawn",
    meter_rate_hz: Annotated[
        float, typer.Option(help="How often the flow meter reports; 0: no meter.")
    ] = 50.0,
    flow_law: Annotated[
        FlowLaw | None,
        typer.Option(help="True flow between measured points; default: the profile's."),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="MODULE:CLASS", help="Your own controller, in place of vrspray's."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for truth, result, picture and journal.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Simulate a mission in closed loop, or fly along a log of your own.

    Faster than real time.

    Example: vrspray sitl fly --config examples/anyang/config.toml --mission
    examples/anyang/mission.waypoints

    Example: vrspray sitl fly --along flight.BIN --out along
    """
    from companion.errors import ConfigError

    if along is not None:
        others = mission, scenario, fidelity, output, speed, corners, controller
        if any(others) or vehicle != "drawn":
            raise ConfigError(
                "--along goes with --config, --plant, --position-rate-hz, --flights, --seed, --out "
                "and --json; leave the others out"
            )
        from sitl.along import AlongOptions, along_lines, fly_along

        result = fly_along(
            AlongOptions(
                log=along, config=config, plant=plant, position_rate_hz=position_rate_hz,
                seed=seed, flights=flights, out=out,
            ),
            note,
        )  # fmt: skip
        return answer(result, along_lines(result), as_json=json)
    if config is None or mission is None:
        raise ConfigError("give --config and --mission, or --along LOG")
    from sitl.fly import FlyOptions, fly_mission
    from sitl.fly_files import fly_lines, write_files

    options = FlyOptions(
        config=config,
        mission=mission,
        scenario=scenario,
        plant=plant,
        fidelity=None if fidelity is None else fidelity.value,
        output=None if output is None else output.value,
        seed=seed,
        speed_m_s=speed,
        corners=None if corners is None else corners.value,
        vehicle=vehicle,
        meter_rate_hz=meter_rate_hz,
        flow_law=None if flow_law is None else flow_law.value,
        controller=controller,
        out=out,
    )
    flown = fly_mission(options, note)
    result = flown.as_json()
    if out is not None:
        result["out"] = [str(path) for path in write_files(flown, out, note)]
    return answer(result, fly_lines(result), as_json=json)


def _run(options: Any) -> dict[str, Any]:
    """Run to the end; the first Ctrl-C or SIGTERM ends the flight with its truth written."""
    import asyncio
    import gc
    import signal

    from sitl.serve import serve as fly

    async def run() -> dict[str, Any]:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, task.cancel)
        # What was loaded so far stays: the collector need not look at it during the flight.
        gc.freeze()
        return await fly(options, note)

    return asyncio.run(run())


def _served(result: dict[str, Any]) -> Iterator[str]:
    yield (
        f"{result['state']}: {result['distance_m']:.0f} m in {result['flight_s']:.0f} s, "
        f"{result['volume_l']:.3f} L sprayed"
    )
    lag = result.get("metrics", {}).get("lag_distance_m", {})
    if lag.get("count"):
        yield (
            f"lag distance of {lag['count']} changes: mean {lag['mean_abs']:.3f} m, "
            f"worst {lag['max_abs']:.3f} m; {result['metrics']['apart']} not measured, "
            f"{result['metrics']['missed']} missed; "
            f"{result['metrics']['off_target_ml']:.1f} mL outside the field"
        )

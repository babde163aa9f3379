"""Flying the golden flights, with the program's own journal; see `flights.py` for which."""

from __future__ import annotations

import heapq
import lzma
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from analysis.journals.content import read_journal
from companion.cli.record_parts import follow
from companion.config import load
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.journal.continuing import continued
from companion.journal.journal import Journal
from missions.maps.compiling import compiled_setup
from sitl.flight import FlightOptions
from sitl.flight import fly as fly_twin
from sitl.fly import _plant
from sitl.motor_parts import ranges_us
from sitl.routes import read_route
from sitl.serve import ServeOptions
from sitl.vehicle import Vehicle
from tests.bench.wire_clock import fly as fly_wire
from tests.golden.checking import FOLDER
from tests.golden.flights import FLIGHTS, Flight
from tests.golden.ground import write_config, write_mission
from tests.virtual_time import START_S


def config_of(flight: Flight, folder: Path) -> Path:
    """Write map, mission and configuration of a flight; return the configuration."""
    path = write_config(
        folder,
        base=flight.base,
        map_name=flight.map,
        autopilot=flight.autopilot,
        settings=flight.settings,
        small_set=flight.small_set,
    )
    write_mission(folder / "golden.waypoints", flight.places)
    return path


def setup_of(flight: Flight, config: Path, journals: Mapping[str, Path]) -> Setup:
    """Return the set-up, going on from an earlier flight where one is named."""
    after = () if flight.after is None else (journals[flight.after],)
    return continued(compiled_setup(load(config)), after)


def record(say: Callable[[str], None], only: tuple[str, ...] = (), out: Path = FOLDER) -> None:
    """Fly and keep each flight, packed."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="golden-") as name:
        journals: dict[str, Path] = {}
        for key, flight in FLIGHTS.items():
            wanted = not only or key in only
            if not wanted and not any(FLIGHTS[one].after == key for one in only):
                continue
            path = journals[key] = fly(key, flight, Path(name) / key, journals)
            content = read_journal(path)
            kinds = [entry.is_decision for entry in content.entries]
            packed = lzma.compress(path.read_bytes(), preset=9 | lzma.PRESET_EXTREME)
            if wanted:
                (out / f"{key}.gpkg.xz").write_bytes(packed)
            decisions = [item for item in content.items() if isinstance(item, Decision)]
            opened = sum(decision.plan.opens for decision in decisions)
            inhibits = sorted({str(one) for made in decisions for one in made.inhibits})
            findings = sorted({str(one.kind) for made in decisions for one in made.findings})
            say(
                f"{key}: {len(decisions)} decisions ({opened} open), "
                f"{len(kinds) - len(decisions)} inputs, {len(packed) / 1000.0:.0f} kB; "
                f"{', '.join(inhibits)}; {', '.join(findings)}"
            )


def fly(key: str, flight: Flight, folder: Path, journals: Mapping[str, Path]) -> Path:
    """Fly one flight; return its journal."""
    config = config_of(flight, folder)
    setup = setup_of(flight, config, journals)
    with Journal.create(
        folder / "flights",
        setup=setup,
        setup_text={"config_toml": config.read_text(encoding="utf-8"), "flight": key},
        started_s=START_S if flight.over == "wire" else 0.0,
        waits=True,
        training="no",
    ) as journal:
        if flight.over == "wire":
            _over_the_wire(flight, config, setup, journal)
        else:
            _in_the_twin(flight, config, setup, journal)
    return journal.path


def _over_the_wire(flight: Flight, config: Path, setup: Setup, journal: Journal) -> None:
    scenario = config.parent / "scenario.toml"
    scenario.write_text(flight.scenario, encoding="utf-8")
    plants = {"pump-sections": "pump-sections", "atomiser": "atomiser"}
    fly_wire(
        config,
        ServeOptions(
            autopilot=flight.autopilot,
            field_config=config,
            mission=config.parent / "golden.waypoints",
            scenario=scenario,
            profile=plants.get(flight.base, "wang-2024"),
            speed_m_s=flight.speed_m_s,
            seed=flight.seed,
        ),
        recorder=journal,
        held_s=flight.held_s,
        setup=setup,
        wired=lambda link, executor: follow(journal, link, executor),
        duration_s=flight.until_s,
    )


def _in_the_twin(flight: Flight, config_file: Path, setup: Setup, journal: Journal) -> None:
    config = load(config_file)
    route = read_route(
        config_file.parent / "golden.waypoints",
        setup.frame,
        speed_m_s=flight.speed_m_s,
        default_speed_m_s=flight.speed_m_s,
    )
    trajectory = Vehicle(route, start_s=0.0, seed=flight.seed).fly_to_end()
    given = {"output": "gpio", "seed": flight.seed, "drive_ranges_us": ranges_us(config)}

    def disturb(items: Iterator[Input]) -> Iterator[Input]:
        extra = sorted(flight.extra, key=lambda item: item.received_s)
        return heapq.merge(items, extra, key=lambda item: item.received_s)

    result = fly_twin(
        setup,
        trajectory,
        _plant(None, setup),
        FlightOptions(**(given | dict(flight.twin))),  # type: ignore[arg-type]
        speed_m_s=flight.speed_m_s,
        observer=journal.record_decision,
        on_input=journal.record_input,
        disturb=disturb,
        mission=route,
    )
    if result.coverage is not None:
        journal.record_coverage(result.coverage)

"""A flight as a journal gets it: fifty decisions a second over the example's field, all inputs."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from shapely import box

from companion.config.model import load
from companion.core.controller import Memory, step
from companion.core.estimator import Track, estimate, observe
from companion.core.options.coverage import Coverage
from companion.core.prescription import Prescription
from companion.core.setup import Setup
from companion.core.types import (
    ClockReport,
    Decision,
    EstimatorReport,
    Fix,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    PressureReport,
    RcReport,
    SpeedReport,
    Telemetry,
    UtcReport,
    WindReport,
)
from companion.journal.rows import ValveOrder, ValveRows
from companion.journal.writer import LinkSample
from missions.maps.compiling import compiled_setup

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/anyang/config.toml"
DECISIONS_HZ = 50
SPEED_M_S = 5.0
SPACING_M = 6.0
START_S = 35_000.0
UTC_S = 1_774_080_000.0


@dataclass(frozen=True, slots=True)
class Turn:
    """What one turn of the control loop gives the journal."""

    inputs: tuple[Input, ...]
    decision: Decision
    orders: tuple[ValveOrder, ...]


def example_setup() -> Setup:
    """Return the set-up of the example: six valves, forty plots."""
    return compiled_setup(load(EXAMPLE))


def open_setup() -> Setup:
    """Return the set-up of a flight whose valves never close: every place has a rate."""
    setup = example_setup()
    ground = setup.prescription
    return replace(
        setup,
        prescription=Prescription(
            ground.zones,
            boundary=box(*ground.field.bounds).buffer(40.0),
            overlap=ground.overlap,
            default_rate_l_ha=80.0,
            sha256=ground.sha256,
        ),
    )


class Field:
    """Passes to and fro along the longer side of the field, half circles between, for ever."""

    def __init__(self, setup: Setup) -> None:
        west, south, east, north = setup.prescription.field.bounds
        self._west, self._south, self._north = west, south, north
        self._length_m = north - south + 20.0
        self._turn_m = math.pi * SPACING_M / 2.0
        self._passes = max(int((east - west) / SPACING_M), 2)

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Return east, north and course [deg] at a time since the start."""
        number, along_m = divmod(time_s * SPEED_M_S, self._length_m + self._turn_m)
        line, is_up = int(number) % self._passes, int(number) % 2 == 0
        east = self._west + SPACING_M * (line + 0.5)
        north = self._south - 10.0 + (along_m if is_up else self._length_m - along_m)
        course = 0.0 if is_up else 180.0
        if along_m > self._length_m:
            turned = (along_m - self._length_m) / (SPACING_M / 2.0)
            east += SPACING_M / 2.0 * (1.0 - math.cos(turned))
            out = SPACING_M / 2.0 * math.sin(turned)
            north = self._north + 10.0 + out if is_up else self._south - 10.0 - out
            course = (course + math.degrees(turned) * (1.0 if is_up else -1.0)) % 360.0
        return east, north, course


class Flight:
    """Makes the turns, the core deciding; deterministic for a seed."""

    def __init__(self, setup: Setup, *, seed: int = 1) -> None:
        self._setup = setup
        self._chance = random.Random(seed)
        self._field = Field(example_setup())
        self._rows = ValveRows()
        self._volume_ml = 0.0
        self.coverage = Coverage()
        self.track, self.memory = Track(), Memory()

    def turns(self, seconds: float) -> Iterator[Turn]:
        """Yield the turns of so many seconds."""
        for number in range(round(seconds * DECISIONS_HZ)):
            yield self.turn(number)

    def turn(self, number: int) -> Turn:
        """Return the next turn."""
        chance = self._chance
        time_s = round(number / DECISIONS_HZ + chance.uniform(0.0, 0.004), 9)
        now_s = round(START_S + time_s, 9)
        inputs = tuple(self._inputs(number, time_s, now_s))
        for item in inputs:
            self.track = observe(self.track, item, self._setup)
        decided_s = round(now_s + chance.uniform(0.0001, 0.0004), 9)
        state = estimate(self.track, decided_s)
        decision, self.memory = step(self._setup, state, self.memory, decided_s)
        self._volume_ml += decision.flow_l_min * 1000.0 / 60.0 / DECISIONS_HZ
        orders = tuple(
            ValveOrder(
                valve=valve,
                duty=permille / 1000.0,
                planned_s=None if planned_us is None else planned_us / 1e6,
                given_s=(planned_us or 0) / 1e6 + chance.uniform(0.0002, 0.002),
            )
            for planned_us, _, valve, permille in self._rows.take_plan(decision.plan)
        )
        return Turn(inputs, decision, orders)

    def treat(self, second: int) -> None:
        """Add what the boom passed over in a second to the coverage."""
        places = [self._field.at(float(at_s)) for at_s in (second, second + 1)]
        sides = []
        for east, north, course in places:
            across = SPACING_M / 2.0
            angle = math.radians(course)
            dx, dy = across * math.cos(angle), -across * math.sin(angle)
            sides.append(((east - dx, north - dy), (east + dx, north + dy)))
        (a, b), (d, c) = sides
        self.coverage = self.coverage.stamped([(a, b, c, d)])

    def link(self, second: int) -> LinkSample:
        """Return what the link tells once a second."""
        chance = self._chance
        return LinkSample(
            at_s=START_S + second + chance.random() * 1e-3,
            values={
                "bytes_in": 4000 * second + chance.randrange(500),
                "bytes_out": 300 * second + chance.randrange(50),
                "frames_in": 90 * second + chance.randrange(9),
                "frames_out": 8 * second,
                "bad_frames": 0,
                "refused_frames": 0,
                "unsent_frames": 0,
                "lost_percent": chance.random() * 0.1,
                "frames_per_s": chance.gauss(90.0, 2.0),
                "bytes_in_per_s": chance.gauss(4000.0, 90.0),
                "bytes_out_per_s": chance.gauss(300.0, 9.0),
                "position_hz": chance.gauss(20.0, 0.2),
                "round_trip_s": chance.gauss(0.002, 0.0002),
            },
        )

    def _inputs(self, number: int, time_s: float, now_s: float) -> Iterator[Input]:
        chance, every = self._chance, lambda hz: number % (DECISIONS_HZ // hz) == 0
        if number % 5 in (0, 2):
            yield self._position(time_s, now_s)
        if every(10):
            yield SpeedReport(received_s=now_s, ground_speed_m_s=_single(chance.gauss(5.0, 0.03)))
            yield FlowReport(received_s=now_s, volume_ml=round(self._volume_ml) / 1.15)
            pressure_kpa = 300.0 + round(chance.gauss(0.0, 20.0)) * 0.0625
            yield PressureReport(received_s=now_s, pressure_kpa=pressure_kpa)
        if every(5):
            yield GnssReport(received_s=now_s, fix=Fix.RTK_FIXED, horizontal_accuracy_m=0.014)
            yield RcReport(
                received_s=now_s, pulse_us=tuple(chance.randint(1498, 1502) for _ in "1234")
            )
        if number % 25 == 0:
            yield EstimatorReport(received_s=now_s, healthy=True)
            yield LandedReport(received_s=now_s, in_air=True)
            yield WindReport(received_s=now_s, speed_m_s=_single(chance.gauss(2.0, 0.2)))
        if every(1):
            yield HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO")
            yield ClockReport(received_s=now_s, offset_s=now_s - time_s, round_trip_s=0.002)
            yield UtcReport(received_s=now_s, utc_s=round(UTC_S + time_s, 6))
        if number == 2 * DECISIONS_HZ:
            yield OperatorCommand(received_s=now_s, enable=True, source="command")

    def _position(self, time_s: float, now_s: float) -> Telemetry:
        chance = self._chance
        east, north, course = self._field.at(time_s)
        latitude, longitude = self._setup.frame.to_geographic(
            east + chance.gauss(0.0, 0.01), north + chance.gauss(0.0, 0.01)
        )
        angle = math.radians(course)
        return Telemetry(
            received_s=now_s,
            boot_s=round(time_s, 3),
            latitude_deg=round(latitude, 7),
            longitude_deg=round(longitude, 7),
            relative_altitude_m=round(3.5 + chance.gauss(0.0, 0.05), 3),
            velocity_north_m_s=round(SPEED_M_S * math.cos(angle) + chance.gauss(0.0, 0.03), 2),
            velocity_east_m_s=round(SPEED_M_S * math.sin(angle) + chance.gauss(0.0, 0.03), 2),
            velocity_down_m_s=round(chance.gauss(0.0, 0.02), 2),
            heading_deg=round((course + chance.gauss(0.0, 0.5)) % 360.0, 2) % 360.0,
        )


def _single(value: float) -> float:
    """Return what a float of four bytes makes of a value, as MAVLink has them."""
    return math.ldexp(round(math.ldexp(math.frexp(value)[0], 24)), math.frexp(value)[1] - 24)

"""A scenario file: its tables, and how it is read.

Every table and key is known; what is not is refused, so that a slip of the pen is no silent
success of a test.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

from pydantic import Field, FiniteFloat

from companion.config.tables import Table
from companion.errors import ConfigError
from companion.wording import read_toml
from sitl.stub.faults import Fault
from sitl.stub.scenario import Scenario
from sitl.stub.sprayer import LiquidEntry

_BYTE = r"(\d{1,2}|1\d\d|2[0-4]\d|25[0-5])"
Delay = Annotated[float, Field(ge=0.0, le=2.0)]
Noise = Annotated[float, Field(ge=0.0, le=10.0)]
Constant = Annotated[float, Field(ge=1.0, le=10_000.0)]
Battery = Annotated[int, Field(ge=0, le=15)]


class _Firmware(Table):
    version: str | None = Field(
        default=None, pattern=rf"^{_BYTE}\.{_BYTE}\.{_BYTE}$", description='such as "1.16.0"'
    )
    commands_per_s: Annotated[float, Field(ge=1.0, le=1000.0)] | None = None


class _Position(Table):
    """What is given stands in place of the airframe's own `EstimatorNoise`."""

    lag_s: Delay = 0.0
    wire_s: Delay = 0.0
    white_m: Noise = 0.0
    drift_m: Noise = 0.0
    drift_time_s: Constant = 1.0
    velocity_m_s: Noise = 0.0
    velocity_drift_m_s: Noise = 0.0
    velocity_drift_time_s: Constant = 1.0


class _Clock(Table):
    drift_ppm: float = Field(default=0.0, ge=-30_000.0, le=30_000.0)
    uptime_s: float = Field(default=0.0, ge=0.0, le=1e8)


class _Wind(Table):
    speed_m_s: float = Field(default=0.0, ge=0.0, le=30.0)
    from_deg: float = Field(default=0.0, ge=0.0, le=360.0)


class _Box(Table):
    closed_s: float = Field(default=0.0, ge=0.0, le=60.0)


class _Signing(Table):
    key: str = Field(pattern="^[0-9a-fA-F]{64}$", description="64 hexadecimal digits")


class _Sensors(Table):
    meter_battery: Battery | None = None
    tank_battery: Battery | None = None
    tank_l: float = Field(default=10.0, ge=0.1, le=1000.0)


class ScenarioFile(Table):
    """The tables of a scenario file."""

    fault: tuple[Fault, ...] = Field(default=(), strict=False)
    parameters: dict[str, FiniteFloat] = Field(default={})
    firmware: _Firmware = _Firmware()
    position: _Position = _Position()
    clock: _Clock = _Clock()
    wind: _Wind = _Wind()
    box: _Box = _Box()
    signing: _Signing | None = None
    sensors: _Sensors = _Sensors()
    liquid: tuple[LiquidEntry, ...] = Field(default=(), strict=False)


def load_scenario(path: Path) -> Scenario:
    """Return what a scenario file says."""
    found = _read(path)
    speed_m_s, from_rad = found.wind.speed_m_s, math.radians(found.wind.from_deg)
    version = found.firmware.version
    parts = [int(part) for part in (version or "0.0.0").split(".")]
    return Scenario(
        source=str(path),
        faults=found.fault,
        version=None if version is None else (parts[0], parts[1], parts[2]),
        commands_per_s=found.firmware.commands_per_s,
        parameters=found.parameters,
        position=found.position.model_dump(exclude_unset=True),
        wind_towards_m_s=(-speed_m_s * math.sin(from_rad), -speed_m_s * math.cos(from_rad)),
        box_closed_s=found.box.closed_s,
        signing_key=None if found.signing is None else bytes.fromhex(found.signing.key),
        liquid=found.liquid,
        **found.clock.model_dump(),
        **found.sensors.model_dump(),
    )


def read_scenario(path: Path) -> tuple[Fault, ...]:
    """Return the faults of a scenario file that holds nothing else."""
    found = _read(path)
    others = sorted(found.model_fields_set - {"fault"})
    if others:
        raise ConfigError(f"{path}: {others[0]}: only [[fault]] has a meaning here")
    return found.fault


def _read(path: Path) -> ScenarioFile:
    _, raw = read_toml(path, what="a scenario", named=f"--scenario {path}")
    return ScenarioFile.checked(raw, path)

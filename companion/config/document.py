"""What a configuration file holds, table by table, before it is asked whether it makes sense."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr

from companion.config import application_table, sprayer_tables, tables
from companion.core.boom import Boom, Valve

if TYPE_CHECKING:
    from companion.config.limits import LimitsFile

Origin = Literal["file", "override", "default"]


class Document(tables.Table):
    """The tables of a file, each with its own rules; `rules.py` has those that join tables."""

    version: int = Field(ge=1, le=1, description="of this format")
    link: tables.LinkTable = tables.LinkTable()
    prescription: tables.PrescriptionTable | None = None
    # The method `boom` returns the core's type, so that the table cannot have the name.
    boom_table: sprayer_tables.BoomTable = Field(alias="boom")
    valve: Annotated[
        tuple[sprayer_tables.ValveTable, ...], Field(strict=False, min_length=1, max_length=256)
    ]
    pwm: sprayer_tables.PwmTable = sprayer_tables.PwmTable()
    nozzle_set: Annotated[
        tuple[sprayer_tables.NozzleSetTable, ...], Field(strict=False, min_length=1, max_length=32)
    ]
    lag: sprayer_tables.LagTable
    output: sprayer_tables.OutputTable = sprayer_tables.OutputTable()
    gpio: sprayer_tables.GpioTable = sprayer_tables.GpioTable()
    pump: sprayer_tables.PumpTable | None = None
    atomiser: Annotated[
        tuple[sprayer_tables.AtomiserTable, ...], Field(strict=False, max_length=32)
    ] = ()
    safety: tables.SafetyTable = tables.SafetyTable()
    mission: tables.MissionTable | None = None
    product: tables.ProductTable = tables.ProductTable()
    mix: Annotated[tuple[tables.MixTable, ...], Field(strict=False, max_length=20)] = ()
    application: application_table.ApplicationTable = application_table.ApplicationTable()
    limits_table: tables.LimitsTable = Field(default=tables.LimitsTable(), alias="limits")
    flow_trim: tables.FlowTrimTable = tables.FlowTrimTable()
    flow_meter: sprayer_tables.FlowMeterTable = sprayer_tables.FlowMeterTable()
    pressure: sprayer_tables.PressureTable = sprayer_tables.PressureTable()
    tank: sprayer_tables.TankTable = sprayer_tables.TankTable()
    detection: sprayer_tables.DetectionTable = sprayer_tables.DetectionTable()
    drift: tables.DriftTable = tables.DriftTable()
    prediction: tables.PredictionTable = tables.PredictionTable()
    coverage: tables.CoverageTable = tables.CoverageTable()
    journal: tables.JournalTable = tables.JournalTable()
    web: tables.WebTable = tables.WebTable()

    _path: Path = PrivateAttr(default=Path("config.toml"))
    _label: LimitsFile | None = PrivateAttr(default=None)
    _source_text: str = PrivateAttr(default="")
    _origins: dict[str, Origin] = PrivateAttr(default_factory=dict)

    def came_from(
        self,
        path: Path,
        *,
        source_text: str,
        origins: dict[str, Origin],
        label: LimitsFile | None = None,
    ) -> Self:
        """Note the file that this was read from and which of its keys are whose; return self."""
        self._label = label
        self._path, self._source_text, self._origins = path, source_text, origins
        return self

    @property
    def path(self) -> Path:
        """Return the file that this was read from."""
        return self._path

    @property
    def label(self) -> LimitsFile | None:
        """Return what label and permit ask for; None where no limits file is named."""
        return self._label

    @property
    def buffers(self) -> tuple[tables.Buffer, ...]:
        """Return the ground that label and permit keep away from."""
        file = self.limits_table.file
        return () if self._label is None or file is None else self._label.buffers(file)

    @property
    def source_text(self) -> str:
        """Return the text of that file, for the record of a flight."""
        return self._source_text

    @property
    def has_motors(self) -> bool:
        """Whether there is a pump or an atomiser whose speed is ordered."""
        return self.pump is not None or bool(self.atomiser)

    @property
    def makes_flow(self) -> bool:
        """Whether a pump's speed makes the flow, and valves are on-off sections."""
        return self.pump is not None and self.pump.control == "modulates"

    @property
    def planned_lines(self) -> str | None:
        """Return the file of the lines that alone are sprayed, as it is named."""
        return None if self.mission is None else self.mission.lines

    @property
    def reads_sensors(self) -> bool:
        """Whether this computer reads any sensor."""
        tables_read = (self.flow_meter, self.pressure, self.tank)
        return self.safety.estop_line is not None or any(each.is_read_here for each in tables_read)

    def resolve(self, name: str) -> Path:
        """Return the path of a file that the configuration names, relative to its own folder."""
        return self._path.parent / name

    def settings(self) -> dict[str, tuple[Any, Origin]]:
        """Return every effective setting by its dotted key, and where it came from."""
        found: dict[str, tuple[Any, Origin]] = {}
        for key, value in leaves(self.model_dump(mode="json", by_alias=True)):
            found[key] = (value, self._origins.get(key, "default"))
        return found

    def boom(self) -> Boom:
        """Return the geometry; strips share the effective width but for a `width_m` of their own.

        With several sets it is the largest whose valves share it: the smaller sets widen it.
        """
        largest = max(len(nozzle_set.valves) for nozzle_set in self.nozzle_set)
        shared_m = self.boom_table.width_m / largest
        return Boom(
            width_m=self.boom_table.width_m,
            height_m=self.boom_table.height_m,
            valves=tuple(
                Valve(
                    name=valve.name,
                    right_m=valve.right_m,
                    forward_m=_or(valve.forward_m, self.boom_table.forward_m),
                    width_m=_or(valve.width_m, shared_m),
                    channel=valve.channel or 0,
                    flow_factor=valve.flow_factor,
                    lag_on_s=valve.lag_on_s,
                    lag_off_s=valve.lag_off_s,
                    lag_up_s=valve.lag_up_s,
                    lag_down_s=valve.lag_down_s,
                )
                for valve in self.valve
            ),
        )


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def leaves(node: Any, key: str = "") -> list[tuple[str, Any]]:
    """Return (dotted key, value) of all settings below `node`; lists of tables get an index.

    >>> leaves({"lag": {"on_s": 0.1}, "valve": [{"name": "1"}]})
    [('lag.on_s', 0.1), ('valve[0].name', '1')]
    """
    if isinstance(node, dict):
        return [
            leaf
            for name, value in node.items()
            for leaf in leaves(value, f"{key}.{name}" if key else str(name))
        ]
    if isinstance(node, list) and any(isinstance(item, dict) for item in node):
        return [
            leaf for number, item in enumerate(node) for leaf in leaves(item, f"{key}[{number}]")
        ]
    return [(key, node)]

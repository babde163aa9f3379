"""From the tables of the motors to the types of the core."""

from __future__ import annotations

from typing import TYPE_CHECKING

from companion.core.atomiser import Atomiser, DropletLaw
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.pump import Pump, Way
from companion.core.schedule import LagModel

if TYPE_CHECKING:
    from companion.config.model import Config
    from companion.config.motor_tables import AtomiserTable, PumpTable

# ASABE S572 and ISO 25358 define the classes by reference nozzles and give no sizes: what is
# measured differs between laboratories. These are the middles of the medians that extension
# services print beside the classes; measure, and write `droplet_um`.
DROPLET_UM = {
    "very fine": 85.0,  # 61 to 105
    "fine": 170.0,  # 106 to 235
    "medium": 290.0,  # 236 to 340
    "coarse": 370.0,  # 341 to 403
    "very coarse": 450.0,  # 404 to 502
    "extremely coarse": 580.0,  # 503 to 665
}


def makes_flow(config: Config) -> bool:
    """Return whether a pump's speed makes the flow, and valves are on-off sections."""
    return config.pump is not None and config.pump.control == "modulates"


def has_valve_outputs(config: Config) -> bool:
    """Return whether valves hang on outputs; without any the nozzles are always open."""
    return any(valve.channel is not None for valve in config.valve)


def way_of(config: Config) -> Way:
    """Return what lets out what is pumped."""
    if makes_flow(config) and not has_valve_outputs(config):
        return "always"
    return "valves" if config.output.return_channel is None else "return"


def pump_curve(table: PumpTable) -> FlowCurve:
    """Return the pump's flow by fraction of its range."""
    span_us = table.max_us - table.stop_us
    return FlowCurve(
        duty=tuple((us - table.stop_us) / span_us for us in table.us), flow_l_min=table.flow_l_min
    )


def pump_of(config: Config) -> Pump | None:
    """Return the pump as the core knows it."""
    table = config.pump
    if table is None:
        return None
    span_us = table.max_us - table.stop_us
    if table.control == "constant":
        return Pump(
            control="constant",
            way=way_of(config),
            lag=_no_lag(),
            run_fraction=((table.run_us or table.max_us) - table.stop_us) / span_us,
        )
    return Pump(
        control="modulates",
        way=way_of(config),
        lag=_lag(config, table),
        curve=pump_curve(table),
        fraction_min=fraction_min(config) or 0.0,
    )


def fraction_min(config: Config) -> float | None:
    """Return the least fraction at which a pump that makes the flow runs; None without one."""
    table = config.pump
    if table is None or not makes_flow(config):
        return None
    least_us = table.us[0] if table.min_us is None else table.min_us
    return (least_us - table.stop_us) / (table.max_us - table.stop_us)


def _lag(config: Config, table: PumpTable) -> LagModel:
    """Return a pump's lags: from standing still its rise comes after its spin-up.

    The rule on the tables has made sure that all of them are there.
    """
    spin_up_s, up_s, down_s = table.spin_up_s or 0.0, table.up_s or 0.0, table.down_s or 0.0
    stop_end_s = table.stop_end_s or 0.0
    return LagModel(
        on_s=max(up_s, spin_up_s + table.up_time_s),
        off_s=min(down_s, stop_end_s),
        up_s=up_s,
        down_s=down_s,
        on_start_s=spin_up_s,
        off_end_s=stop_end_s,
        output_s=config.lag.output_s,
        position_s=config.lag.position_s,
        up_time_s=table.up_time_s,
        down_time_s=table.down_time_s,
    )


def _no_lag() -> LagModel:
    return LagModel(
        on_s=0.0, off_s=0.0, up_s=0.0, down_s=0.0, on_start_s=0.0, off_end_s=0.0, output_s=0.0
    )


def droplet_um(config: Config, table: AtomiserTable) -> float | None:
    """Return the wanted median diameter; None where nothing says it."""
    if table.droplet_um is not None:
        return table.droplet_um
    return DROPLET_UM.get((config.product.droplet_class or "").strip().lower())


def atomiser_of(config: Config, table: AtomiserTable) -> Atomiser:
    """Return an atomiser as the core knows it; all of them share the flow alike."""
    span_us = table.us[-1] - table.stop_us
    return Atomiser(
        name=table.name,
        speed=FlowCurve(
            duty=tuple((us - table.stop_us) / span_us for us in table.us), flow_l_min=table.rpm
        ),
        law=DropletLaw(
            um=table.vmd_um,
            rpm=table.vmd_rpm,
            flow_l_min=table.vmd_flow_l_min,
            rpm_exponent=table.rpm_exponent,
            flow_exponent=table.flow_exponent,
        ),
        droplet_um=droplet_um(config, table) or table.vmd_um,
        share=1.0 / len(config.atomiser),
        spin_up_s=table.spin_up_s,
        run_on_s=table.run_on_s,
    )


def atomisers_of(config: Config) -> tuple[Atomiser, ...]:
    """Return all atomisers, in the order of their tables."""
    return tuple(atomiser_of(config, table) for table in config.atomiser)


def pump_set(config: Config) -> NozzleSet | None:
    """Return all valves with the pump's curve; None where the valves' own curves count."""
    if config.pump is None or not makes_flow(config):
        return None
    index = {valve.name: number for number, valve in enumerate(config.valve)}
    (table,) = config.nozzle_set
    return NozzleSet(
        valves=tuple(sorted(index[name] for name in table.valves)), curve=pump_curve(config.pump)
    )

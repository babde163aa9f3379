"""What the tables of the motors must say together with the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.options.atomisers import Atomiser, DropletLaw
from companion.core.options.pump import Pump, PumpOutlet
from companion.core.schedule import LagModel

if TYPE_CHECKING:
    from companion.config.document import Document
    from companion.config.sprayer_tables import AtomiserTable, PumpTable


Found = Iterator[tuple[str, str]]
SPAN_MIN_US = 100


def motor_contradictions(config: Document) -> Found:
    """Yield (key, what is wrong and what to write instead)."""
    if config.pump is not None:
        yield from _pulses(config.pump)
        if config.makes_flow:
            yield from _modulating(config, config.pump)
            if any(valve.flow_factor != 1.0 for valve in config.valve):
                yield (
                    "valve[0].flow_factor",
                    "the pump makes the flow and the valves only open and shut, so none can be "
                    "dosed by itself; leave it out",
                )
        else:
            yield from _constant(config.pump)
    for number, table in enumerate(config.atomiser):
        yield from _atomiser(config, table, f"atomiser[{number}]")
    yield from _outputs(config)
    yield from _closed_pulse(config)


def motor_warnings(config: Document) -> Found:
    """Yield what works, and is unwise."""
    pump = config.pump
    if pump is not None and pump.control == "constant" and config.output.return_channel is None:
        yield (
            "pump.control",
            "without output.return_channel the pump stops with the last valve and starts with the "
            "first: the flow comes late at each of them",
        )
    if config.makes_flow and len(config.valve) > 1:
        yield (
            "pump.control",
            "one pump gives all sections one rate: where the map asks them for different ones, "
            "only their sum is right",
        )
    for number, table in enumerate(config.atomiser):
        least = _rpm(config, table, _flows(config)[0])
        if not least >= table.rpm[0]:
            yield (
                f"atomiser[{number}].rpm",
                f"at the least flow {least:.0f} rpm would do, its curve begins at "
                f"{table.rpm[0]:g}: droplets are smaller there",
            )


def _pulses(pump: PumpTable) -> Found:
    if not pump.max_us - pump.stop_us >= SPAN_MIN_US:
        yield (
            "pump.max_us",
            f"less than {SPAN_MIN_US} us above pump.stop_us = {pump.stop_us}; write the two ends "
            "of the ESC's range, such as 1000 and 2000",
        )
    for key in ("min_us", "run_us"):
        value = getattr(pump, key)
        if value is not None and not pump.stop_us < value <= pump.max_us:
            yield (
                f"pump.{key}",
                f"not above pump.stop_us = {pump.stop_us} and at most pump.max_us = "
                f"{pump.max_us}; write a pulse at which it runs",
            )


def _constant(pump: PumpTable) -> Found:
    if pump.run_us is None:
        yield "pump.run_us", 'missing; with control = "constant" write the pulse at which it runs'


def _modulating(config: Document, pump: PumpTable) -> Found:
    for key in ("us", "flow_l_min"):
        if not getattr(pump, key):
            yield f"pump.{key}", "missing; write the measured curve of the pump"
    for key in ("spin_up_s", "up_s", "down_s", "stop_end_s"):
        if getattr(pump, key) is None:
            yield f"pump.{key}", "missing; write the lag as measured"
    if pump.run_us is not None:
        yield "pump.run_us", 'goes with control = "constant"; remove it'
    yield from _increasing("pump", {"us": pump.us, "flow_l_min": pump.flow_l_min})
    if pump.us and not pump.stop_us < pump.us[0] <= pump.us[-1] <= pump.max_us:
        yield (
            "pump.us",
            f"reaches outside pump.stop_us = {pump.stop_us} to pump.max_us = {pump.max_us}; "
            "correct one or the other",
        )
    if pump.min_us is not None and pump.us and not pump.min_us <= pump.us[-1]:
        yield "pump.min_us", f"above the curve, which ends at {pump.us[-1]}; write less"
    for key in ("up", "down"):
        whole_s, part_s = getattr(pump, f"{key}_s"), getattr(pump, f"{key}_time_s")
        if not part_s <= whole_s:
            yield (
                f"pump.{key}_time_s",
                f"a part of pump.{key}_s = {whole_s:g}; write at most that",
            )
    yield from _sections(config)


def _sections(config: Document) -> Found:
    """Yield what does not go with valves that are on-off sections behind the pump."""
    if len(config.nozzle_set) > 1:
        yield "nozzle_set", "a pump that makes the flow has one set; name all valves in one"
    (table, *_) = config.nozzle_set
    if table.duty or table.flow_l_min:
        yield (
            "nozzle_set[0].duty",
            "the pump makes the flow, and its curve counts; remove duty and flow_l_min",
        )
    pulsing = sorted(config.pwm.model_fields_set - {"valve"})
    if pulsing:
        yield (
            f"pwm.{pulsing[0]}",
            "valves behind a pump that makes the flow are on-off and do not pulse; remove it, or "
            'write pump.control = "constant"',
        )
    for key in ("up_time_s", "down_time_s"):
        if getattr(config.lag, key):
            yield f"lag.{key}", f"of the pump: write it as pump.{key}"
    missing = [n for n, valve in enumerate(config.valve) if valve.channel is None]
    if missing and has_valve_outputs(config):
        yield (
            f"valve[{missing[0]}].channel",
            "missing; write it for each valve, or for none where the nozzles are always open",
        )
    if not has_valve_outputs(config) and config.output.return_channel is not None:
        yield (
            "output.return_channel",
            "no valve has a channel: the way out is never shut; give valves channels or remove it",
        )
    if not has_valve_outputs(config) and config.output.kind == "gpio":
        yield "output.kind", 'no valve has a channel, so there is nothing on lines; write "servo"'


def _increasing(key: str, curve: dict[str, tuple[float, ...]]) -> Found:
    (first, one), (second, other) = curve.items()
    if len(one) != len(other):
        yield (
            f"{key}.{second}",
            f"{len(other)} values for {len(one)} pulses; write one for each",
        )
    for name, values in ((first, one), (second, other)):
        if not all(a < b for a, b in pairwise(values)):
            yield (
                f"{key}.{name}",
                "must be strictly increasing; write the points in order of the pulse",
            )


def _atomiser(config: Document, table: AtomiserTable, key: str) -> Found:
    broken = [*_increasing(key, {"us": table.us, "rpm": table.rpm})]
    if broken:
        yield from broken
        return
    if not table.us[-1] - table.stop_us >= SPAN_MIN_US or not table.stop_us < table.us[0]:
        yield (
            f"{key}.us",
            f"not all above {key}.stop_us = {table.stop_us}; correct one or the other",
        )
        return
    if droplet_um(config, table) is None:
        yield (
            f"{key}.droplet_um",
            "missing, and product.droplet_class is none of "
            + ", ".join(f'"{name}"' for name in DROPLET_UM)
            + "; write the wanted median diameter",
        )
        return
    fastest = _rpm(config, table, _flows(config)[1])
    if not fastest <= table.rpm[-1]:
        yield (
            f"{key}.rpm",
            f"{fastest:.0f} rpm are wanted at the largest flow, the curve ends at "
            f"{table.rpm[-1]:g}; write a larger droplet_um, or fit more atomisers",
        )


def _flows(config: Document) -> tuple[float, float]:
    """Return the least and the largest flow of the boom; 0 where no curve says it."""
    pump = config.pump
    if pump is not None and config.makes_flow:
        flows = [pump_curve(pump).flow_l_min] if pump.us and pump.flow_l_min else []
    else:
        each_set = [table.points(config.valve)[1] for table in config.nozzle_set]
        flows = [points for points in each_set if points]
    if not flows:
        return 0.0, 0.0
    return min(each[0] for each in flows), max(each[-1] for each in flows)


def _rpm(config: Document, table: AtomiserTable, boom_flow_l_min: float) -> float:
    atomiser = atomiser_of(config, table)
    flow_l_min = atomiser.share * boom_flow_l_min
    return atomiser.law.rpm_for(atomiser.droplet_um, flow_l_min) if flow_l_min > 0.0 else 0.0


def _every(config: Document) -> dict[str, PumpTable | AtomiserTable]:
    """Return all motors by their keys, the pump first."""
    every: dict[str, PumpTable | AtomiserTable] = {}
    if config.pump is not None:
        every["pump"] = config.pump
    every |= {f"atomiser[{number}]": table for number, table in enumerate(config.atomiser)}
    return every


def on_autopilot(config: Document) -> dict[str, int | None]:
    """Return the motors' outputs of the autopilot, by key."""
    return {
        f"{key}.channel": table.channel
        for key, table in _every(config).items()
        if table.output == "autopilot"
    }


def _closed_pulse(config: Document) -> Found:
    """Yield a closed pulse at which a motor runs.

    The watchdog script has one pulse for all outputs that it guards. When this computer is dead,
    what closes the valves has to stop the motors too.
    """
    output = config.output
    for key, table in _every(config).items():
        if table.output != "autopilot":
            continue
        if not output.closed_us <= table.stop_us:
            yield (
                "output.closed_us",
                f"above {key}.stop_us = {table.stop_us}: the watchdog script would run that motor "
                f"with it; write at most {table.stop_us}",
            )
        if not output.full_us > output.closed_us:
            yield (
                "output.full_us",
                f"not above output.closed_us = {output.closed_us}: with {key} on the autopilot "
                f"pulses must open as they grow; turn the valves' driver, or write {key}.output "
                '= "pwm"',
            )


def _outputs(config: Document) -> Found:
    """Yield outputs that are none, or that two share."""
    every = _every(config)
    found: dict[str, tuple[str, int, int]] = {}
    for key, table in every.items():
        if table.output == "autopilot" and table.channel < 1:
            yield f"{key}.channel", "no servo output; write one from 1 to 32"
        chip = table.chip if table.output == "pwm" else -1
        found[f"{key}.channel"] = (table.output, chip, table.channel)
    if config.output.kind == "servo":
        for number, valve in enumerate(config.valve):
            if valve.channel is not None:
                found[f"valve[{number}].channel"] = ("autopilot", -1, valve.channel)
        if config.output.return_channel is not None:
            found["output.return_channel"] = ("autopilot", -1, config.output.return_channel)
    counts = Counter(found.values())
    for key, where in found.items():
        if counts[where] > 1 and not key.startswith(("valve", "output")):
            yield key, "used twice; give each valve and each motor its own output"


# From the tables of the motors to the types of the core.

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


def has_valve_outputs(config: Document) -> bool:
    """Return whether valves hang on outputs; without any the nozzles are always open."""
    return any(valve.channel is not None for valve in config.valve)


def outlet_of(config: Document) -> PumpOutlet:
    """Return what lets out what is pumped."""
    if config.makes_flow and not has_valve_outputs(config):
        return "always"
    return "valves" if config.output.return_channel is None else "return"


def pump_curve(table: PumpTable) -> FlowCurve:
    """Return the pump's flow by fraction of its range."""
    span_us = table.max_us - table.stop_us
    return FlowCurve(
        duty=tuple((us - table.stop_us) / span_us for us in table.us), flow_l_min=table.flow_l_min
    )


def pump_of(config: Document) -> Pump | None:
    """Return the pump as the core knows it."""
    table = config.pump
    if table is None:
        return None
    span_us = table.max_us - table.stop_us
    if table.control == "constant":
        return Pump(
            control="constant",
            outlet=outlet_of(config),
            lag=_no_lag(),
            run_fraction=((table.run_us or table.max_us) - table.stop_us) / span_us,
        )
    return Pump(
        control="modulates",
        outlet=outlet_of(config),
        lag=_lag(config, table),
        curve=pump_curve(table),
        fraction_min=fraction_min(table),
    )


def fraction_min(table: PumpTable) -> float:
    """Return the least fraction at which a pump that makes the flow runs."""
    least_us = table.us[0] if table.min_us is None else table.min_us
    return (least_us - table.stop_us) / (table.max_us - table.stop_us)


def _lag(config: Document, table: PumpTable) -> LagModel:
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


def droplet_um(config: Document, table: AtomiserTable) -> float | None:
    """Return the wanted median diameter; None where nothing says it."""
    if table.droplet_um is not None:
        return table.droplet_um
    return DROPLET_UM.get((config.product.droplet_class or "").strip().lower())


def atomiser_of(config: Document, table: AtomiserTable) -> Atomiser:
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


def atomisers_of(config: Document) -> tuple[Atomiser, ...]:
    """Return all atomisers, in the order of their tables."""
    return tuple(atomiser_of(config, table) for table in config.atomiser)


def pump_set(config: Document, pump: PumpTable) -> NozzleSet:
    """Return all valves with the curve of the pump that makes their flow."""
    index = {valve.name: number for number, valve in enumerate(config.valve)}
    (table,) = config.nozzle_set
    return NozzleSet(
        valves=tuple(sorted(index[name] for name in table.valves)), curve=pump_curve(pump)
    )

"""From the options of `vrspray ground` to a piece of work: valves, duty, time, what to expect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from companion.config import Config
from companion.config.motor_rules import atomisers_of, pump_of
from companion.core.nozzle import allowed_duty
from companion.errors import VrsprayError
from companion.ground.work import (
    PIECE_MAX_S,
    GroundKind,
    GroundSetup,
    GroundTask,
    clicks,
    expected_ml,
    flow_of,
    in_turn,
    together,
)

# Where no pump says how long its hoses take.
PRIME_S = 10.0
FLUSH_EACH_S, CATCH_S = 5.0, 25.0


class GroundOptionError(VrsprayError):
    """An option of `vrspray ground` that cannot be followed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """The options as they were given; None where one was not."""

    kind: GroundKind
    valves: tuple[str, ...] = ()
    duty: float | None = None
    seconds: float | None = None
    litres: float | None = None
    is_together: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """A piece of work, ready to be done, with the valves' names."""

    task: GroundTask
    valves: tuple[int, ...]
    names: tuple[str, ...]
    duty: float  # of the valves, or of a pump that makes the flow

    def expected_ml(self, config: Config) -> float:
        """Return what falls into the cups of a catch, by the measured curve."""
        pump = pump_of(config)
        lag = config.lag_model() if pump is None or pump.curve is None else pump.lag
        flow_l_min = _flow_l_min(config, self.valves, self.duty)
        return expected_ml(flow_l_min, open_s=self.task.seconds, lag=lag)


def piece_of(config: Config, wish: Wish) -> Piece:
    """Return the work that the options mean; `GroundOptionError` says which one cannot be."""
    names = tuple(valve.name for valve in config.valve)
    for name in wish.valves:
        if name not in names:
            raise GroundOptionError(f"--valve {name}: there is none; the valves are {_all(names)}")
    chosen = tuple(
        number for number, name in enumerate(names) if not wish.valves or name in wish.valves
    )
    duty = _duty(config, wish)
    try:
        task = replace(
            _task(config, wish, len(names), chosen, duty),
            drives=_drives(config, wish.kind, chosen, duty),
        )
    except ValueError as error:
        raise GroundOptionError(f"{wish.kind}: {error}; {_ADVICE[wish.kind]}") from error
    return Piece(
        task=task, valves=chosen, names=tuple(names[number] for number in chosen), duty=duty
    )


_ADVICE = {
    GroundKind.PRIME: "give --seconds from 1 to 30",
    GroundKind.FLUSH: "give --seconds from 1 to 30",
    GroundKind.RINSE: "give fewer --litres, or --seconds from 1 to 30, and do it again",
    GroundKind.CATCH: "give --seconds from 1 to 30",
    GroundKind.CLICK: "choose some by --valve",
}


def _task(config: Config, wish: Wish, count: int, valves: Sequence[int], duty: float) -> GroundTask:
    if wish.kind is GroundKind.CLICK:
        return clicks(count, valves)
    seconds = _seconds(config, wish, valves)
    if config.makes_flow:
        duty = 1.0  # the duty is the pump's; the valves are its sections
    if wish.kind in (GroundKind.FLUSH, GroundKind.RINSE) and not wish.is_together:
        return in_turn(wish.kind, count, valves, duty=duty, seconds=seconds)
    return together(wish.kind, count, valves, duty=duty, seconds=seconds)


def _duty(config: Config, wish: Wish) -> float:
    if wish.kind is not GroundKind.CATCH:
        return 1.0
    if wish.duty is None:
        raise GroundOptionError("catch: give --duty, such as --duty 0.5")
    pump = pump_of(config)
    if pump is not None and pump.curve is not None:
        low, can = pump.fraction_min, pump.fraction_min <= wish.duty
    else:
        low, can = config.pwm.duty_min, allowed_duty(wish.duty, config.pwm_limits()) == wish.duty
    if not (0.0 < wish.duty <= 1.0 and can):
        raise GroundOptionError(f"--duty {wish.duty:g}: give {low:g} to 1, what the valves can do")
    return wish.duty


def _drives(
    config: Config, kind: GroundKind, valves: Sequence[int], duty: float
) -> tuple[float, ...]:
    """Return what pump and atomisers do; nothing while valves click dry."""
    return () if kind is GroundKind.CLICK else drives_while(config, valves, duty)


def drives_while(config: Config, valves: Sequence[int], duty: float) -> tuple[float, ...]:
    """Return what pump and atomisers do while these valves spray at a duty."""
    pump = pump_of(config)
    drives = [] if pump is None else [duty if pump.curve is not None else pump.run_fraction]
    flow_l_min = _flow_l_min(config, valves, duty)
    return (*drives, *(atomiser.fraction_for(flow_l_min) for atomiser in atomisers_of(config)))


def _flow_l_min(config: Config, valves: Sequence[int], duty: float) -> float:
    """Return the flow out of these valves; all that a pump makes goes out of those that are open.

    The duty is the pump's then.
    """
    pump = pump_of(config)
    if pump is not None and pump.curve is not None:
        return pump.curve.flow_for(duty)
    return flow_of(config.nozzle_sets(), valves, duty)


def _seconds(config: Config, wish: Wish, valves: Sequence[int]) -> float:
    if wish.seconds is not None:
        return wish.seconds
    if wish.kind is GroundKind.PRIME:
        prime_s = 0.0 if config.pump is None else config.pump.prime_s
        return min(prime_s or PRIME_S, PIECE_MAX_S)
    if wish.kind is GroundKind.FLUSH:
        return min(FLUSH_EACH_S * (1 if wish.is_together else len(valves)), PIECE_MAX_S)
    if wish.kind is GroundKind.CATCH:
        return CATCH_S
    if wish.litres is None:
        raise GroundOptionError("rinse: give --litres, or --seconds")
    # In turn each valve is open for the same time, so that their mean flow counts.
    groups = [valves] if wish.is_together else [(valve,) for valve in valves]
    flows = [_flow_l_min(config, group, 1.0) for group in groups]
    return 60.0 * wish.litres * len(flows) / sum(flows)


def ground_setup(config: Config) -> GroundSetup:
    """Return what ground work has to know of the configuration."""
    limits = config.limits()
    return GroundSetup(
        modes=limits.modes,
        heartbeat_age_max_s=limits.heartbeat_age_max_s,
        lease_s=config.output.lease_s,
        has_servo_outputs=needs_autopilot(config),
        has_estop_line=config.safety.estop_line is not None,
        rc_channel=limits.rc_channel,
    )


def needs_autopilot(config: Config) -> bool:
    """Return whether anything hangs on the autopilot's outputs."""
    if config.output.kind == "none":
        return False
    ways = [atomiser.output for atomiser in config.atomiser]
    if config.pump is not None:
        ways.append(config.pump.output)
    return config.output.kind == "servo" or "autopilot" in ways


def plan_line(piece: Piece) -> str:
    """Return in one sentence what will be done."""
    valves, seconds = _all(piece.names), f"{piece.task.seconds:.3g} s"
    kind = piece.task.kind
    if kind is GroundKind.CLICK:
        return f"click: valves {valves} in turn, each twice for 0.2 s, dry ({seconds} in all)"
    if len(piece.task.phases) > 1:
        return f"{kind}: valves {valves} in turn, fully open, {seconds} in all"
    how = f"at duty {piece.duty:g} for exactly" if kind is GroundKind.CATCH else "fully open for"
    return f"{kind}: valves {valves} together, {how} {seconds}"


def csv_line(piece: Piece, open_s: float) -> str:
    """Return the row for `calibrate flow`, with a ? where the measured millilitres belong."""
    return f"{piece.duty:g},{open_s:.3f},?,{' '.join(piece.names)}"


def _all(names: Sequence[str]) -> str:
    return ", ".join(names)

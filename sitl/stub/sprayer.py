"""The sprayer behind the servo outputs: driver boards and the twin's plant, and its truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from sitl.board import SERVO_FRAME_S, DriverBoard
from sitl.drives import Motors
from sitl.plants import edge_plant
from sitl.profile import FlowLaw, load_profile
from sitl.stub.liquid import SPRAYING, Battery, Liquid, LiquidOptions
from sitl.stub.outputs import ServoOrder

Floats = NDArray[np.float64]
_MEMORY_S = 1.0
# A command of 44 bytes over a telemetry port, less what the loopback takes itself.
_WIRE_S = 0.001
BoardKind = Literal["restarting", "free-running"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SprayerOptions:
    """Which sprayer, and how it is wired: one servo channel a valve, left to right.

    `drive_channels` are the pump's, where it has an order of its own, and the atomisers'.
    `flow_law` says how the flow runs between measured points; None: as the profile.
    """

    profile: str = "wang-2024"
    board: BoardKind = "restarting"
    channels: tuple[int, ...] = (9, 10, 11, 12, 13, 14)
    closed_us: float = 1000.0
    full_us: float = 2000.0
    box_closed_s: float = 0.0  # how long a box wants to see the closed pulse first; 0: no such box
    liquid: LiquidOptions | None = None
    seed: int = 0
    drive_channels: tuple[int, ...] = ()
    flow_law: FlowLaw | None = None


class _Both:
    """The pump's orders to both plants of one sprayer."""

    def __init__(self, *plants: object) -> None:
        self._plants = plants

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on."""
        for plant in self._plants:
            plant.record_pump(at_s, pulse_us)  # type: ignore[attr-defined]


class Sprayer:
    """Takes servo orders and gives cumulative volumes; keeps every order that it took."""

    def __init__(self, options: SprayerOptions, *, start_s: float) -> None:
        profile = load_profile(options.profile)
        if options.flow_law is not None:
            profile = replace(profile, flow_law=options.flow_law)
        if len(options.channels) != profile.valve_count:
            raise ConfigError(
                f"the configuration wires {len(options.channels)} valves, the sprayer "
                f"{options.profile} has {profile.valve_count}; choose another with --profile"
            )
        if len(options.drive_channels) != profile.drive_count:
            raise ConfigError(
                f"the configuration wires {len(options.drive_channels)} motors, the sprayer "
                f"{options.profile} has {profile.drive_count}; choose another with --profile"
            )
        if not options.closed_us < options.full_us:
            raise ConfigError("output.closed_us must be below output.full_us for this board")
        self.options = options
        self.orders: list[ServoOrder] = []
        self._box = ArmingBox(
            closed_s=options.box_closed_s,
            closed_us=options.closed_us,
            full_us=options.full_us,
        )
        self._valves = {channel: valve for valve, channel in enumerate(options.channels)}
        self._drives = {channel: number for number, channel in enumerate(options.drive_channels)}
        self._plant = edge_plant(profile, seed=options.seed, start_s=start_s)
        # The same sprayer once more, with a short memory: from a whole flight of 150 s the litres
        # of now took 4 to 8 ms (measured on two x86 cores), so 1 to 2; the wire waits meanwhile.
        self._recent = edge_plant(profile, seed=options.seed, start_s=start_s)
        self.motors = Motors(profile, _Both(self._plant, self._recent), start_s=start_s)
        self.liquid: Liquid | None = None
        if options.liquid is not None:
            self.liquid = Liquid(
                options.liquid,
                self._recent,
                also=(self._plant,),
                start_s=start_s,
                seed=options.seed,
            )
        self._is_opened = False
        self._board = DriverBoard(
            profile.pwm,
            profile.valve_count,
            seed=options.seed,
            start_s=start_s,
            kind=options.board,
            closed_us=options.closed_us,
            full_us=options.full_us,
            # As in the closed loop: only the restarting board is built for its valve.
            overrun_s=profile.overrun_s if options.board == "restarting" else 0.0,
        )

    def take(self, order: ServoOrder) -> None:
        """Take an order of the autopilot; those of other outputs are none of ours."""
        drive = self._drives.get(order.channel)
        if drive is not None:
            # No pulse is a stop to a speed controller, as one that is too short is.
            at_s = order.at_s + _WIRE_S + 0.5 * SERVO_FRAME_S
            self.motors.order(at_s, drive, order.pulse_us)
        valve = self._valves.get(order.channel)
        if valve is not None:
            self.orders.append(order)
            if not self._box.passes(order):
                return
            if not self._is_opened and order.pulse_us > self.options.closed_us:
                self._is_opened = True
                self.begins(SPRAYING, order.at_s)
            self._board.order(order.at_s + _WIRE_S, valve, order.pulse_us)

    def advance(self, until_s: float) -> None:
        """Work the valves out up to a time."""
        edges = self._board.advance(until_s)
        self._plant.record(edges)
        self._recent.record(edges)
        if self.liquid is not None:
            self.liquid.advance(until_s, self.volume_l)

    def batteries(self, now_s: float) -> list[Battery]:
        """Return the battery monitors as they are now, however long ago the last tick was."""
        if self.liquid is None:
            return []
        self.advance(now_s)
        return self.liquid.batteries()

    def begins(self, moment: str, at_s: float) -> None:
        """Take that a moment has come from which faults of the liquid count."""
        if self.liquid is not None:
            self.liquid.begins(moment, at_s)

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return (n, valves): what each valve has delivered up to each time."""
        return self._plant.volume_ml(times_s)

    def volume_l(self, now_s: float) -> float:
        """Return what all valves have delivered; asked for in order of time."""
        self._recent.forget(now_s - _MEMORY_S)
        return float(self._recent.volume_ml(np.array([now_s])).sum()) / 1000.0


# A driver box that has to be armed, as speed controllers of motors do.
#
# It passes nothing on until it has seen the closed pulse for a while without a break; when the
# pulses end it has to be armed again. An order that opens before that makes it begin anew. Some
# boxes on the market are built that way; the board of this project is not.

_PULSE_MIN_US = 800.0
# Of the span: a width this near to closed is closed, as at the driver board.
_CLOSED_DUTY = 0.01


class ArmingBox:
    """One input a channel; says of each order whether it is passed on."""

    def __init__(self, *, closed_s: float, closed_us: float, full_us: float) -> None:
        self._closed_s = closed_s
        self._closed_max_us = closed_us + _CLOSED_DUTY * (full_us - closed_us)
        self._closed_since_s: dict[int, float] = {}
        self._armed: set[int] = set()

    def passes(self, order: ServoOrder) -> bool:
        """Take an order in and return whether it reaches the valve."""
        channel = order.channel
        if order.pulse_us < _PULSE_MIN_US:
            self._armed.discard(channel)
            self._closed_since_s.pop(channel, None)
            return True
        since_s = self._closed_since_s.get(channel)
        if since_s is not None and order.at_s - since_s >= self._closed_s:
            self._armed.add(channel)
        if order.pulse_us <= self._closed_max_us:
            self._closed_since_s.setdefault(channel, order.at_s)
            return True
        self._closed_since_s.pop(channel, None)
        return channel in self._armed or self._closed_s == 0.0

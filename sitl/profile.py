"""What a simulated sprayer is made of: measured curves, delays, scatter, meter; read from TOML.

What real valves and supplies have and no controller here models: it has to be calibrated away. All
of it is off unless a profile has a table `[imperfections]`. The truth is this file; the controller
sees valves only through the flow meter.
"""

from __future__ import annotations

import math
import tomllib
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from companion.errors import ConfigError
from sitl.supply import Atomiser, Supply, read_atomiser


@dataclass(frozen=True, slots=True, kw_only=True)
class Imperfections:
    """How parts depart from the profile; scatters are 1 sd between the valves of a sprayer.

    `offset_scatter_s`: a valve delivers so much longer than its pulse, at every duty.
    `curvature_scatter`: how much more of its flow a valve gives at full duty than at none.
    `interaction`: the share of its flow that a valve loses when all others open beside it.
    `ripple` at `ripple_hz`: the supply's pressure swings, as that of a hunting regulator.
    `rest_lag_s`: a valve that was shut opens so much later, a share of it after `rest_time_s`.
    `pressure_lag_s`: one that opens while no other is open has the most pressure against it.
    `warming`: how much more flows once coils and hoses are warm, after `warming_time_s`.
    """

    offset_scatter_s: float = 0.0
    curvature_scatter: float = 0.0
    interaction: float = 0.0
    ripple: float = 0.0
    ripple_hz: float = 0.5
    rest_lag_s: float = 0.0
    rest_time_s: float = 1.0
    pressure_lag_s: float = 0.0
    warming: float = 0.0
    warming_time_s: float = 300.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"imperfections: {each.name} must not be negative, got {value}")
        if not (self.interaction < 0.5 and self.ripple < 0.5 and self.curvature_scatter < 0.3):
            raise ValueError("imperfections: interaction, ripple below 0.5, curvature below 0.3")
        if not (self.offset_scatter_s < 0.01 and self.ripple_hz <= 5.0):
            raise ValueError("imperfections: offset below 0.01 s, ripple_hz 5 at most")
        if not (self.rest_lag_s < 0.05 and self.pressure_lag_s < 0.05):
            raise ValueError("imperfections: lags must be below 0.05 s")
        if not (self.rest_time_s > 0.0 and self.warming_time_s > 0.0):
            raise ValueError("imperfections: times must be positive")

    @property
    def alike(self) -> Imperfections:
        """Return the same with all valves alike."""
        return replace(self, offset_scatter_s=0.0, curvature_scatter=0.0)


# After what makers and papers say of such parts. A solenoid's opening and closing times repeat
# within 0.5 to 1 ms between units; the flow of pulsed nozzles departs from a straight line in duty
# by 1 to 3 % (P1's own Table 2 by up to 4 %); nozzle pressure falls by 5 to 10 % from few open
# valves to all (Fabula et al. 2021; P1: 290 against 227 kPa), half of it in flow; a regulator hunts
# by 1 %; a valve at rest, or against more pressure, opens some ms later; water that warms by 10 K
# and an elastomer seat let 1 % more pass. Which of it a given sprayer has, nobody knows beforehand.
TYPICAL = Imperfections(
    offset_scatter_s=0.0005,
    curvature_scatter=0.02,
    interaction=0.04,
    ripple=0.01,
    rest_lag_s=0.003,
    pressure_lag_s=0.002,
    warming=0.01,
)


class Parts:
    """The parts of one sprayer, drawn by its seed."""

    def __init__(self, what: Imperfections, count: int, *, seed: int, start_s: float) -> None:
        self.what = what
        self._start_s = start_s
        rng = np.random.default_rng((seed, 22))
        draws = np.clip(rng.standard_normal((2, count)), -3.0, 3.0)
        # What all valves have alike is in the measured curve already.
        draws -= draws.mean(axis=1, keepdims=True)
        self._longer_s: list[float] = (what.offset_scatter_s * draws[0]).tolist()
        self._bend: list[float] = (what.curvature_scatter * draws[1]).tolist()
        self._phase = float(rng.uniform(0.0, 2.0 * math.pi))
        self._count = count
        self._closed_s = [-math.inf] * count

    @property
    def moves_others(self) -> bool:
        """Return whether an edge of one valve changes the flow of all that are open."""
        return self.what.interaction > 0.0 or self.what.ripple > 0.0

    def scale(self, valve: int, at_s: float, duties: list[float], are_open: list[bool]) -> float:
        """Return the flow of an open valve over that of the profile."""
        what, duty = self.what, duties[valve]
        usual = sum(duties) / self._count
        now = sum(are_open) / self._count
        since_s = at_s - self._start_s
        return (
            (1.0 + self._bend[valve] * (duty - 0.5))
            * (1.0 - what.interaction * (now - usual))
            * (1.0 + what.ripple * math.sin(2.0 * math.pi * what.ripple_hz * at_s + self._phase))
            * (1.0 + what.warming * -math.expm1(-since_s / what.warming_time_s))
        )

    def late_s(self, valve: int, at_s: float, are_open: list[bool], *, is_open: bool) -> float:
        """Return how much later than the profile's an edge is."""
        what = self.what
        if not is_open:
            self._closed_s[valve] = at_s
            return self._longer_s[valve]
        rest_s = at_s - self._closed_s[valve]
        others = (sum(are_open) - 1) / max(self._count - 1, 1)
        rested = -math.expm1(-rest_s / what.rest_time_s)
        return what.rest_lag_s * rested + what.pressure_lag_s * (1.0 - others)


# The flow of a nozzle set by its duty: three laws for what a table leaves open.
#
# A bucket test tells the flow at a few duties. What lies between nobody has measured, so that a
# figure of a flight must not rest on one reading of it, least of all on the controller's own.
#
# - `smooth`: through every point without a kink (M. Steffen, Astron. Astrophys. 239, 1990,
# 443-450); - `straight`: through every point, straight between them; - `offset`: what a valve
# does by its mechanics. Each pulse delivers as long as it lasts, less what
#   opening takes more than closing: `flow = k (duty - d0)`, by least squares near the points; from
#   the last duty with a gap the flow goes straight up to that of an open valve.
#
# Below the first point the flow falls in proportion to zero, by every law.

Floats = NDArray[np.float64]
FlowLaw = Literal["smooth", "straight", "offset"]
FLOW_LAWS: tuple[FlowLaw, ...] = get_args(FlowLaw)


def flow_by_law(
    law: FlowLaw, duty: tuple[float, ...], flow_l_min: tuple[float, ...], wanted: Floats
) -> Floats:
    """Return the flow [L/min] at the duties `wanted`, from the measured points.

    >>> points = ((0.2, 0.5, 1.0), (1.0, 2.0, 4.0))
    >>> [float(flow_by_law(law, *points, np.array([0.5]))[0]) for law in ("smooth", "straight")]
    [2.0, 2.0]
    >>> flow_by_law("straight", *points, np.array([0.0, 0.1, 0.75])).tolist()
    [0.0, 0.5, 3.0]
    """
    x, y = np.array(duty), np.array(flow_l_min)
    at = np.clip(wanted, x[0], x[-1])
    if law == "smooth":
        flow = _smooth(x, y, at)
    elif law == "straight":
        flow = np.interp(at, x, y)
    else:
        flow = _offset(x, y, at)
    below = np.clip(wanted / x[0], 0.0, 1.0) if x[0] > 0.0 else (wanted > 0.0).astype(np.float64)
    result: Floats = flow * below
    return result


def _smooth(x: Floats, y: Floats, at: Floats) -> Floats:
    """Return Steffen's curve: monotone between the points, its slope without a jump.

    Its ends are straight on: nobody knows of a bend before the first or behind the last point.
    """
    h = np.diff(x)
    rise = np.diff(y) / h
    slope = np.concatenate((rise[:1], np.zeros(len(x) - 2), rise[-1:]))
    if len(x) > 2:
        left, right = rise[:-1], rise[1:]
        parabola = (left * h[1:] + right * h[:-1]) / (h[:-1] + h[1:])
        slope[1:-1] = 2.0 * np.minimum(np.minimum(left, right), 0.5 * parabola)
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(h) - 1)
    t = at - x[i]
    bend = (3.0 * rise[i] - 2.0 * slope[i] - slope[i + 1]) / h[i]
    twist = (slope[i] + slope[i + 1] - 2.0 * rise[i]) / h[i] ** 2
    result: Floats = y[i] + t * (slope[i] + t * (bend + t * twist))
    return result


def _offset(x: Floats, y: Floats, at: Floats) -> Floats:
    """Return k (duty - d0) up to the last duty below 1, straight from there to the last flow."""
    pulsed = x < 1.0
    if pulsed.sum() < 2:
        return np.interp(at, x, y)
    k, above = np.polyfit(x[pulsed], y[pulsed], 1)
    line = np.clip(k * at + above, 0.0, y[-1])
    last = float(x[pulsed][-1])
    if last == x[-1]:
        return np.asarray(line)
    end = min(k * last + above, float(y[-1]))
    result: Floats = np.where(at <= last, line, np.interp(at, (last, x[-1]), (end, y[-1])))
    return result


PROFILES = Path(__file__).parent / "profiles"
ML_S_PER_L_MIN = 1000.0 / 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pulsing:
    """What the valves can follow; `duty_max` is the last duty below fully open."""

    frequency_hz: float
    duty_min: float
    duty_max: float
    min_on_s: float
    min_off_s: float

    def __post_init__(self) -> None:
        if not 0.1 <= self.frequency_hz <= 1000.0:
            raise ValueError(f"frequency_hz must lie in [0.1, 1000], got {self.frequency_hz}")
        if not 0.0 <= self.duty_min < self.duty_max <= 1.0:
            raise ValueError("0 <= duty_min < duty_max <= 1 must hold")
        if not (self.min_on_s >= 0.0 and self.min_off_s >= 0.0):
            raise ValueError("min_on_s and min_off_s must not be negative")
        if not self.min_on_s + self.min_off_s < self.period_s:
            raise ValueError("min_on_s and min_off_s together must be shorter than a period")

    @property
    def period_s(self) -> float:
        """Return the length of a PWM period."""
        return 1.0 / self.frequency_hz


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredSet:
    """Valves that spray together, and what a bucket test found of them: duty, and flow of all."""

    valves: tuple[int, ...]
    duty: tuple[float, ...]
    flow_l_min: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.valves or len(set(self.valves)) != len(self.valves):
            raise ValueError(f"a nozzle set needs valves, each once, got {self.valves}")
        if len(self.duty) != len(self.flow_l_min) or len(self.duty) < 2:
            raise ValueError("a nozzle set needs as many duties as flows, two at least")
        for name, values in (("duty", self.duty), ("flow_l_min", self.flow_l_min)):
            if not all(a < b for a, b in pairwise(values)):
                raise ValueError(f"{name} must be strictly increasing, got {list(values)}")
        if not (self.duty[0] >= 0.0 and self.duty[-1] <= 1.0):
            raise ValueError(f"duty must lie in [0, 1], got {list(self.duty)}")
        if not (self.flow_l_min[0] >= 0.0 and self.flow_l_min[-1] < 1e6):
            raise ValueError(f"flow_l_min must be finite and not negative: {self.flow_l_min}")

    @property
    def flow_max_l_min(self) -> float:
        """Return the largest measured flow."""
        return self.flow_l_min[-1]

    def flows_l_min(self, law: FlowLaw, duty: Floats) -> Floats:
        """Return the flow of all its valves by a law for what lies between the points."""
        return flow_by_law(law, self.duty, self.flow_l_min, duty)


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """The ground that one valve covers: its middle right of the boom's own, and its width."""

    right_m: float
    width_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """A turbine meter in the supply line of all valves."""

    pulses_per_l: float
    gain_spread: float
    noise: float
    lag_s: float

    def __post_init__(self) -> None:
        if not self.pulses_per_l > 0.0:
            raise ValueError(f"pulses_per_l must be positive, got {self.pulses_per_l}")
        if not all(0.0 <= value < 1.0 for value in (self.gain_spread, self.noise, self.lag_s)):
            raise ValueError("gain_spread, noise and lag_s must lie in [0, 1)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Pump:
    """A pump whose speed makes the flow: dead time, then an exponential, slower up than down.

    With `shut_off` a valve behind it opens and shuts the boom; the pump holds its speed meanwhile.
    """

    dead_s: float
    up_s: float
    down_s: float
    shut_off: bool

    def __post_init__(self) -> None:
        if not all(0.0 <= value <= 10.0 for value in (self.dead_s, self.up_s, self.down_s)):
            raise ValueError("dead_s, up_s and down_s of a pump must lie in [0, 10] s")
        if not (self.up_s > 0.0 and self.down_s > 0.0):
            raise ValueError("up_s and down_s of a pump must be positive")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantProfile:
    """One sprayer. Sets are ordered from the smallest; each contains the one before it.

    An edge at the driver becomes flow `dead_open_s` (or `dead_close_s`) later, as a ramp of
    `ramp_s` (`ramp_close_s` where closing takes another time). The scatters are 1 sd between
    valves: of the whole lag, and of the flow. With a `pump` it is the pump's speed that makes the
    flow, and the edges are those of its shut-off valve. A `supply` is a pump with an order of its
    own, and what is not PWM is on-off; the curve of a pump that modulates is of its range.
    `flow_law` is how the flow runs between the measured points.
    `imperfections` are those of the parts, of which the curve and the lags above know nothing.
    """

    name: str
    boom_width_m: float
    valve_count: int
    normally_open: bool
    pwm: Pulsing
    nozzle_sets: tuple[MeasuredSet, ...]
    dead_open_s: float
    dead_close_s: float
    ramp_s: float
    lag_scatter: float
    flow_scatter: float
    meter: Meter
    ramp_close_s: float | None = None
    pump: Pump | None = None
    supply: Supply | None = None
    atomisers: tuple[Atomiser, ...] = ()
    flow_law: FlowLaw = "smooth"
    imperfections: Imperfections | None = None

    def __post_init__(self) -> None:
        if not self.nozzle_sets or not 0.0 < self.boom_width_m < 1000.0:
            raise ValueError("a sprayer needs a nozzle set and a boom")
        known: set[int] = set()
        for nozzle_set in self.nozzle_sets:
            if not known < set(nozzle_set.valves) <= set(range(self.valve_count)):
                raise ValueError(f"a set must contain the one before it, got {nozzle_set.valves}")
            known = set(nozzle_set.valves)
        if not 0.0 <= self.dead_open_s <= self.dead_close_s <= 10.0:
            raise ValueError("0 <= dead_open_s <= dead_close_s <= 10 must hold")
        if not self.overrun_s <= self.pwm.min_off_s:
            raise ValueError("a valve that closes slower than min_off_s never closes")
        if not (0.0 < self.ramp_s < 10.0 and 0.0 <= self.lag_scatter < 0.3):
            raise ValueError("ramp_s must be positive, lag_scatter below 0.3")
        if not 0.0 <= self.flow_scatter < 0.3:
            raise ValueError(f"flow_scatter must lie in [0, 0.3), got {self.flow_scatter}")
        if not 0.0 < self.closing_s <= self.ramp_s:
            raise ValueError("0 < ramp_close_s <= ramp_s must hold")
        if self.pump is not None and not (
            self.valve_count == 1
            and self.dead_open_s == self.dead_close_s
            and self.closing_s == self.ramp_s
        ):
            raise ValueError("a pump has one valve_count, with equal edges to open and to shut")
        self._check_kinds()

    def _check_kinds(self) -> None:
        if self.imperfections is not None and (self.pump is not None or self.has_sections):
            raise ValueError("[imperfections] are those of PWM valves, and here are none")
        if self.flow_law not in FLOW_LAWS:
            raise ValueError(f"flow_law is one of {', '.join(FLOW_LAWS)}, got {self.flow_law!r}")
        if self.pump is not None and self.supply is not None:
            raise ValueError("[pump] and [supply] are two kinds of sprayer; give one of them")
        for atomiser in self.atomisers:
            if not set(atomiser.valves) <= set(range(self.valve_count)):
                raise ValueError(f"atomiser {atomiser.name}: no such valves {atomiser.valves}")

    @property
    def strips(self) -> tuple[Strip, ...]:
        """Return the strips of the valves side by side, valve 0 at the left."""
        width_m = self.boom_width_m / self.valve_count
        middle = 0.5 * (self.valve_count - 1)
        return tuple(
            Strip(right_m=(valve - middle) * width_m, width_m=width_m)
            for valve in range(self.valve_count)
        )

    @property
    def drive_count(self) -> int:
        """Return how many motors have an order of their own."""
        return (self.supply is not None) + len(self.atomisers)

    @property
    def has_sections(self) -> bool:
        """Return whether a pump makes the flow, and valves only open and shut."""
        return self.supply is not None and self.supply.control == "modulates"

    @property
    def makes_flow(self) -> Pump | None:
        """Return how the flow follows the pump that makes it; None where valves do."""
        supply = self.supply
        if supply is None or supply.control != "modulates":
            return self.pump
        return Pump(
            dead_s=supply.dead_s, up_s=supply.up_s, down_s=supply.down_s, shut_off=supply.valves
        )

    @property
    def closing_s(self) -> float:
        """Return the length of a closing valve's ramp."""
        return self.ramp_s if self.ramp_close_s is None else self.ramp_close_s

    @property
    def surplus_s(self) -> float:
        """Return how much longer a valve delivers than its pulse lasts; negative: less long."""
        return self.dead_close_s - self.dead_open_s + 0.5 * (self.closing_s - self.ramp_s)

    @property
    def overrun_s(self) -> float:
        """Return the surplus that pulse engine and driver board reckon with: never below 0."""
        return max(self.surplus_s, 0.0)

    @property
    def mean_lag_s(self) -> float:
        """Return the volume-equivalent lag of a train of pulses: that of a pulse's middle."""
        ramps_s = 0.5 * (self.ramp_s + self.closing_s)
        return 0.5 * (self.dead_open_s + self.dead_close_s + ramps_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatter:
    """How each valve differs from the nominal one in this sprayer."""

    shift_s: tuple[float, ...]
    flow_scale: tuple[float, ...]


def draw_scatter(profile: PlantProfile, rng: np.random.Generator) -> Scatter:
    """Draw one sprayer: the flow of every set is kept, for that is what calibration measured."""
    count = profile.valve_count
    shift_s = np.clip(rng.standard_normal(count), -3.0, 3.0) * (
        profile.lag_scatter * profile.mean_lag_s
    )
    scale = np.clip(rng.standard_normal(count), -3.0, 3.0) * profile.flow_scatter
    known: set[int] = set()
    for nozzle_set in profile.nozzle_sets:
        new = [valve for valve in nozzle_set.valves if valve not in known]
        # Taking the mean away takes spread away with it: n / (n - 1) gives it back.
        scale[new] = (scale[new] - scale[new].mean()) * math.sqrt(len(new) / max(len(new) - 1, 1))
        known.update(new)
    return Scatter(shift_s=tuple(shift_s.tolist()), flow_scale=tuple((1.0 + scale).tolist()))


@cache
def flow_table(profile: PlantProfile) -> FlowTable:
    """Return the table of a profile; it costs more than a flight needs of it."""
    return FlowTable(profile)


class FlowTable:
    """Mean flow of one nominal valve [mL/s] by duty and by how many valves are in use.

    Fewer valves in use leave more pressure to each: between two measured sets the flow of a valve
    is interpolated by the number in use, and outside of them held. Tables of 4 001 duties, because
    a law is too slow for every step of a flight; their error is below 1e-5.
    """

    STEPS = 4000

    def __init__(self, profile: PlantProfile) -> None:
        self._pwm, self._law = profile.pwm, profile.flow_law
        self._surplus = profile.surplus_s * profile.pwm.frequency_hz
        self._tables = [self._table(profile, active) for active in range(profile.valve_count + 1)]

    def _table(self, profile: PlantProfile, active: int) -> list[float]:
        sizes = [len(nozzle_set.valves) for nozzle_set in profile.nozzle_sets]
        right = bisect_right(sizes, active)
        low, high = max(right - 1, 0), min(right, len(sizes) - 1)
        span = sizes[high] - sizes[low]
        share = (active - sizes[low]) / span if span else 0.0
        flows = (1.0 - share) * self._valve_flows(profile.nozzle_sets[low])
        flows += share * self._valve_flows(profile.nozzle_sets[high])
        return [float(flow) for flow in flows]

    def _valve_flows(self, measured: MeasuredSet) -> Floats:
        duties = np.linspace(0.0, 1.0, self.STEPS + 1)
        flows = measured.flows_l_min(self._law, duties)
        return flows * (ML_S_PER_L_MIN / len(measured.valves))

    def mean_ml_s(self, duty: float, active: int) -> float:
        """Return the mean flow of one valve at `duty` while `active` valves are in use."""
        place = duty * self.STEPS
        i = min(int(place), self.STEPS - 1)
        table = self._tables[active]
        return table[i] + (table[i + 1] - table[i]) * (place - i)

    def duty_for(self, flow_ml_s: float, active: int) -> float:
        """Return the duty of a mean flow of one valve; fully open where it gives no more."""
        table = self._tables[active]
        i = bisect_left(table, flow_ml_s)
        if i == 0 or i > self.STEPS:
            return min(i / self.STEPS, 1.0)
        return (i - (table[i] - flow_ml_s) / (table[i] - table[i - 1])) / self.STEPS

    def open_ml_s(self, duty: float, active: int) -> float:
        """Return the flow of one open valve in a train of pulses: such that the mean is right."""
        # Above the last duty whole periods take turns, and only some of them have a gap.
        last = min(self._pwm.duty_max, 1.0 - self._pwm.min_off_s / self._pwm.period_s)
        with_gap = 1.0 if duty <= last else (1.0 - duty) / (1.0 - last)
        share = duty + self._surplus * with_gap
        return self.mean_ml_s(duty, active) / min(max(share, 1e-3), 1.0)


def load_profile(name: str | Path) -> PlantProfile:
    """Read a profile by its name, or from a TOML file."""
    path = Path(name)
    if path.suffix != ".toml":
        path = PROFILES / f"{name}.toml"
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        names = ", ".join(sorted(file.stem for file in PROFILES.glob("*.toml")))
        raise ConfigError(f"no sprayer profile {str(name)!r}: choose one of {names}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as TOML: {error}") from error
    try:
        return _profile(table)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise ConfigError(f"{path}: {reason}") from error


def _profile(table: dict[str, Any]) -> PlantProfile:
    sets = tuple(
        MeasuredSet(
            valves=tuple(entry["valves"]),
            duty=tuple(entry["duty"]),
            flow_l_min=tuple(entry["flow_l_min"]),
        )
        for entry in table.pop("nozzle_set")
    )
    pwm, meter, flow = table.pop("pwm"), table.pop("meter"), table.pop("flow")
    pump, supply = table.pop("pump", None), table.pop("supply", None)
    imperfections = table.pop("imperfections", None)
    atomisers = tuple(read_atomiser(entry) for entry in table.pop("atomiser", ()))
    return PlantProfile(
        pwm=Pulsing(**pwm),
        meter=Meter(**meter),
        nozzle_sets=sets,
        pump=None if pump is None else Pump(**pump),
        supply=None if supply is None else Supply(**supply),
        atomisers=atomisers,
        imperfections=None if imperfections is None else Imperfections(**imperfections),
        **flow,
        **table,
    )

"""A method of one's own in a simulated flight: `--controller module:Class`.

A class that says at each position message which duty every valve is to have (`Controller`). It sees
what the companion sees, and never the truth. The companion's interlock stands around it: where the
core would not spray, its orders close every valve. Simulation only: `vrspray run` takes no such
class (docs/howto/own-method.md).
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Protocol, cast

from companion.core.estimator import Track, estimate, observe
from companion.core.frame import course_deg
from companion.core.nozzle import allowed_duty, flow_for_rate
from companion.core.safety import UNASKED, Permission, guard, permit
from companion.core.types import Inhibit, Input, SprayPlan, Telemetry, TimedChange
from companion.errors import ConfigError

if TYPE_CHECKING:
    from companion.core.setup import Setup
    from companion.core.types import VehicleState
    from sitl.outputs import Output

# An order holds for so long: where no position follows, every valve closes.
LEASE_S = 1.0
# Of an order that is to take effect later.
AFTER_MAX_S = 10.0
# Processor time of one answer, many thousand times what any needs; then it is raised so often.
ANSWER_MAX_S, AGAIN_S = 10.0, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """A position message, in metres east and north of the flight's origin.

    `now_s` is when it arrived, by the computer's clock, which rises through the flight. Heading is
    where the nose points, in degrees clockwise from north. `may_spray` is the interlock's word:
    where it is False, whatever is ordered closes the valves.
    """

    now_s: float
    east_m: float
    north_m: float
    velocity_east_m_s: float
    velocity_north_m_s: float
    heading_deg: float | None
    height_m: float
    may_spray: bool

    @property
    def speed_m_s(self) -> float:
        """Return the speed over the ground."""
        return math.hypot(self.velocity_east_m_s, self.velocity_north_m_s)

    @property
    def course_deg(self) -> float:
        """Return the direction of motion, clockwise from north."""
        return course_deg(self.velocity_east_m_s, self.velocity_north_m_s)

    def ahead(self, time_s: float) -> tuple[float, float]:
        """Return east and north of the place that is reached in `time_s` at this velocity."""
        return (
            self.east_m + time_s * self.velocity_east_m_s,
            self.north_m + time_s * self.velocity_north_m_s,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """A duty, 0 to 1, for each valve from left to right, to take effect `after_s` from now.

    It replaces what was ordered for later than that. `restart` begins the PWM period anew at the
    change; without it a valve takes the duty with its next period.
    """

    duties: Sequence[float]
    after_s: float = 0.0
    restart: bool = True


class Sprayer:
    """What is known before the flight: the map, the boom, and the measured curve of the valves."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        # Of each valve, how far right of the middle of the boom it is.
        self.valves_right_m = tuple(valve.right_m for valve in setup.boom.valves)
        self.width_m = setup.boom.width_m

    def rate_l_ha(self, east_m: float, north_m: float) -> float | None:
        """Return the prescribed rate at a place; None outside the field."""
        return self.setup.prescription.rate_at(east_m, north_m)

    def flow_l_min(self, rate_l_ha: float, speed_m_s: float) -> float:
        """Return the flow of the whole boom that a rate takes at a speed."""
        return flow_for_rate(rate_l_ha, speed_m_s, self.width_m)

    def duties(self, rate_l_ha: float | None, speed_m_s: float) -> tuple[float, ...]:
        """Return the same duty for every valve, by the measured curve; 0 where there is no rate."""
        count = len(self.valves_right_m)
        if rate_l_ha is None:
            return (0.0,) * count
        flow_l_min = self.flow_l_min(rate_l_ha, speed_m_s)
        curve = self.setup.nozzle_sets[-1].curve
        return (allowed_duty(curve.duty_for(flow_l_min), self.setup.pwm),) * count


class Controller(Protocol):
    """A method: made with a `Sprayer` before the flight, then asked at each position message."""

    def order(self, seen: Seen) -> Order | Sequence[float] | None:
        """Return an order, or the duties alone for at once; None leaves all as it was ordered."""


class MakeController(Protocol):
    """A class of controllers."""

    __name__: str

    def __call__(self, sprayer: Sprayer, /) -> Controller:
        """Return one for a flight."""


class EndlessError(BaseException):
    """A method that comes to no answer; no Exception, which the method may swallow."""


class ControllerError(ConfigError):
    """A method of one's own that cannot be loaded, raised, or ordered what is no order."""


# Whatever a method raises; Ctrl-C is nobody's fault.
RAISED = (Exception, SystemExit, EndlessError)


@contextmanager
def _in_time() -> Iterator[None]:
    """Raise in what takes too much processor time; other threads are a campaign's to bound."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        raise EndlessError(f"no answer within {ANSWER_MAX_S:g} s of processor time, a loop?")

    before = signal.signal(signal.SIGVTALRM, end)
    signal.setitimer(signal.ITIMER_VIRTUAL, ANSWER_MAX_S, AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


# ------------------------------------------------------------------------------------------ loading


def load_controller(name: str) -> MakeController:
    """Return the class that `module:Class` or `file.py:Class` names.

    Modules of the working folder are found too, after those that are installed.

    Raises:
        ControllerError: it cannot be imported, or is not there; in one line.
    """
    place, _, attribute = name.rpartition(":")
    if not place or not attribute.isidentifier():
        raise ControllerError(f"--controller {name}: give module:Class or file.py:Class")
    try:
        with _in_time():
            module = _file(Path(place)) if place.endswith(".py") else _module(place)
    except RAISED as error:
        raise ControllerError(f"--controller {name}: {_why(error)}") from error
    found = getattr(module, attribute, None)
    if not isinstance(found, type) or not callable(getattr(found, "order", None)):
        kind = "no class" if found is None else "no class with a method order(self, seen)"
        raise ControllerError(
            f"--controller {name}: {kind} {attribute} in {getattr(module, '__file__', place)}"
        )
    return cast(MakeController, found)


def made(make: MakeController, name: str, sprayer: Sprayer) -> Controller:
    """Return the method, made for a flight.

    Raises:
        ControllerError: it raised; in one line.
    """
    try:
        with _in_time():
            return make(sprayer)
    except RAISED as error:
        raise ControllerError(f"{name}: {_why(error)}, before the flight") from error


def _module(name: str) -> ModuleType:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    importlib.invalidate_caches()
    return importlib.import_module(name)


def _file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _why(error: BaseException) -> str:
    """Return what went wrong and the last line of it that is not ours, in one line."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}, line {error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [each for each in frames if "importlib" not in each.filename]
    theirs = [each for each in theirs if Path(each.filename) != Path(__file__)]
    where = f" ({Path(theirs[-1].filename).name}, line {theirs[-1].lineno})" if theirs else ""
    return f"{type(error).__name__}: {error}{where}"


# ------------------------------------------------------------------------------------------- flying


@dataclass(slots=True)
class OwnFlight:
    """One flight of a method: its orders become plans, which the interlock lets through or not."""

    controller: Controller
    name: str
    setup: Setup
    output: Output
    steps: int = 0
    inhibits: set[Inhibit] = field(default_factory=set)
    _permission: Permission = UNASKED
    _plan: SprayPlan | None = None
    _pending: list[tuple[float, tuple[float, ...], bool]] = field(default_factory=list)

    def fly(
        self,
        inputs: Iterator[Input],
        *,
        start_s: float,
    ) -> None:
        """Ask the method at each position message, to the end.

        Raises:
            ControllerError: the method raised, or ordered what is no order; the valves are closed.
        """
        track = Track()
        for item in inputs:
            track = observe(track, item, self.setup)
            if not isinstance(item, Telemetry):
                continue
            now_s = item.received_s
            state = estimate(track, now_s)
            try:
                plan = self._asked(item, state, now_s)
            except RAISED as error:
                self._submit(self._plan_of((), now_s, open_=False), now_s)
                raise ControllerError(
                    f"{self.name}: {_why(error)}, {now_s - start_s:.1f} s after the start of the "
                    "flight; all valves closed, the flight ended"
                ) from error
            self._submit(plan, now_s)

    def _asked(self, item: Telemetry, state: VehicleState | None, now_s: float) -> SprayPlan:
        """Return the plan after one message."""
        setup = self.setup
        self._permission = permit(
            self._permission, state, setup.limits, faults=frozenset(),
            field_bounds_m=setup.prescription.bounds_m, now_s=now_s,
        )  # fmt: skip
        reasons = self._permission.reasons
        self.inhibits |= reasons
        velocity = item.velocity_east_m_s, item.velocity_north_m_s
        if state is not None and state.position_valid and None not in velocity:
            self._ask(item, state, now_s, may_spray=not reasons)
        plan = self._plan_of(self._pending, now_s, open_=not reasons)
        if reasons:
            self._pending.clear()
        return guard(plan, reasons, lease_s=LEASE_S)

    def _ask(self, item: Telemetry, state: VehicleState, now_s: float, *, may_spray: bool) -> None:
        """Take what the method orders after a message; one without place or speed is not shown."""
        east_m, north_m = self.setup.frame.to_local(item.latitude_deg, item.longitude_deg)
        seen = Seen(
            now_s=now_s,
            east_m=east_m,
            north_m=north_m,
            velocity_east_m_s=item.velocity_east_m_s or 0.0,
            velocity_north_m_s=item.velocity_north_m_s or 0.0,
            heading_deg=item.heading_deg,
            height_m=state.height_m,
            may_spray=may_spray,
        )
        with _in_time():
            answer = self.controller.order(seen)
        if answer is not None:
            self._take(answer, now_s)

    def _take(self, answer: Order | Sequence[float], now_s: float) -> None:
        """Check an order and put it among those to come."""
        order = answer if isinstance(answer, Order) else Order(duties=answer)
        duties = tuple(float(duty) for duty in order.duties)
        count = len(self.setup.boom.valves)
        if len(duties) != count:
            raise ValueError(f"{len(duties)} duties ordered for {count} valves")
        if not all(0.0 <= duty <= 1.0 for duty in duties):
            raise ValueError(f"ordered a duty outside 0 to 1: {duties}")
        if not 0.0 <= order.after_s <= AFTER_MAX_S:
            raise ValueError(f"after_s is {order.after_s}; give 0 to {AFTER_MAX_S:g} s")
        at_s = now_s + order.after_s
        self._pending = [each for each in self._pending if each[0] < at_s]
        self._pending.append((at_s, duties, order.restart))

    def _plan_of(
        self,
        pending: Sequence[tuple[float, tuple[float, ...], bool]],
        now_s: float,
        *,
        open_: bool,
    ) -> SprayPlan:
        """Return a plan that goes on with what is in force, and changes as `pending` says."""
        before = self._plan
        closed = (0.0,) * len(self.setup.boom.valves)
        in_force = closed if before is None or not open_ else before.duty_at(now_s)
        self._pending = [each for each in pending if each[0] >= now_s]
        return SprayPlan(
            sequence=1 if before is None else before.sequence + 1,
            issued_s=now_s,
            duty=in_force,
            changes=tuple(
                TimedChange(at_s=at_s, valve=valve, duty=duty, restart=restart)
                for at_s, duties, restart in self._pending
                for valve, duty in enumerate(duties)
            ),
            lease_until_s=now_s + LEASE_S,
        )

    def _submit(self, plan: SprayPlan, now_s: float) -> None:
        self._plan = plan
        self.output.submit(plan, now_s=now_s)
        self.steps += 1

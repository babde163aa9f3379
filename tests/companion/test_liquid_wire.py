"""A valve sticks open: `run` sees it in the autopilot's meter, names it and closes.

How soon and by which name is asked here of flights on a clock of their own, without a link or a
computer that stands still, and with one; `realtime/test_liquid_wire.py` flies in real time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from companion.core.options.coverage import Coverage
from companion.core.types import Decision, Input
from sitl.serve import ServeOptions
from tests.bench.wire import example
from tests.bench.wire_clock import START_S, Holds, fly
from tests.companion.realtime.test_liquid_wire import CLOSED_MAX_S, STUCK, check_closed
from tests.companion.realtime.test_wire_flight import write_field, write_mission

pytestmark = pytest.mark.sitl

# 3 s are for a pulse meter on this computer; the autopilot's counts are compared over 0.55 s.
FOUND_MAX_S = 5.0
# Where everything stands still for a fifth of a second every 1.1 s: bins are longer there.
FOUND_HELD_UP_MAX_S = 8.0
# The fault is after 14 s; then it stays closed where the map asks for liquid.
FLOWN_S = 28.0


@dataclass
class Events:
    """A recorder that keeps what happened."""

    found: list[tuple[float, str]] = field(default_factory=list)

    def record_input(self, item: Input) -> None: ...

    def record_decision(self, decision: Decision) -> None: ...

    def record_coverage(self, coverage: Coverage) -> None: ...

    def record_event(self, at_s: float, kind: str, text: str) -> None:
        if kind.startswith("fault-"):
            self.found.append((at_s, kind))


def never(_at_s: float) -> float:
    return 0.0


def a_fifth_of_a_second(at_s: float) -> float:
    return max(0.2 - at_s % 1.1, 0.0)


@dataclass(frozen=True, kw_only=True)
class Hold:
    """Everything stands still for `length_s` every `period_s`, from `phase_s` before the start."""

    phase_s: float
    period_s: float = 1.1
    length_s: float = 0.2

    def __call__(self, at_s: float) -> float:
        return max(self.length_s - (at_s + self.phase_s) % self.period_s, 0.0)


@pytest.mark.parametrize(
    ("held_s", "within_s"), [(never, FOUND_MAX_S), (a_fifth_of_a_second, FOUND_HELD_UP_MAX_S)]
)
@pytest.mark.parametrize("seed", [1, 2, 4])
def test_a_stuck_valve_is_named_at_once_though_everything_stands_still_now_and_then(
    tmp_path: Path, held_s: Holds, within_s: float, seed: int
) -> None:
    check_named(tmp_path, held_s, seed=seed, within_s=within_s)


# What was learnt of the meter's gain in the three seconds before the fault holds a part of it, and
# the sums of evidence begin before it: these were called leaks of 5 to 13 % of the flow.
@pytest.mark.parametrize(
    ("seed", "held_s"),
    [
        (1, Hold(phase_s=0.16023618061454337)),
        (1, Hold(phase_s=1.076955132080052)),
        (4, Hold(phase_s=0.9040975551204736, period_s=0.7, length_s=0.25)),
        (6, Hold(phase_s=0.4414064206448092)),
        (8, Hold(phase_s=0.11564792116050351, length_s=0.1)),
    ],
)
def test_a_stuck_valve_is_no_leak_though_the_meters_gain_is_hardly_known(
    tmp_path: Path, held_s: Holds, seed: int
) -> None:
    check_named(tmp_path, held_s, seed=seed, within_s=FOUND_HELD_UP_MAX_S)


@pytest.mark.parametrize("start_s", [0.0, 64.0, 1000.0, 2048.0, 12345.6])
def test_a_stuck_valve_is_named_whatever_the_clock_says_at_the_start(
    tmp_path: Path, start_s: float
) -> None:
    check_named(
        tmp_path, a_fifth_of_a_second, seed=2, within_s=FOUND_HELD_UP_MAX_S, start_s=start_s
    )


def check_named(
    folder: Path, held_s: Holds, *, seed: int, within_s: float, start_s: float = START_S
) -> None:
    """Fly the short field with a valve that sticks, and check what is found of it, and when."""
    config = example(folder / "field", autopilot="ardupilot", port=14550)
    write_field(config.parent)
    write_mission(config.parent / "short.waypoints")
    text = config.read_text().replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"')
    text += '\n[flow_meter]\nsource = "autopilot"\n\n[detection]\nenabled = true\n'
    config.write_text(text)
    scenario = folder / "stuck.toml"
    scenario.write_text(STUCK)
    events, out = Events(), folder / "truth"
    result, fault = fly(
        config,
        ServeOptions(
            field_config=config,
            mission=config.parent / "short.waypoints",
            scenario=scenario,
            seed=seed,
            out=out,
        ),
        recorder=events,
        held_s=held_s,
        start_s=start_s,
        duration_s=FLOWN_S,
    )
    assert fault is None
    ((what, fault_s),) = [(one["fault"], one["from_s"]) for one in result["liquid"]]
    assert what == "stuck-open, valve 3"
    assert {kind for _, kind in events.found} == {"fault-stuck-open"}
    found_s = events.found[0][0]
    assert 0.0 < found_s - fault_s <= within_s
    check_closed(out, found_s, within_s=CLOSED_MAX_S + held_s(0.0))

"""What the engine proves before it is ready, on lines and a clock of this test's own."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.core.types import PwmLimits
from companion.output.engine.lines import MemoryLines
from companion.output.engine.selftest import ROUNDS, WAKE_S, WAKES, SelfTest, self_test
from companion.output.engine.wire import WAKE_LATE_MAX_S, EngineSetup, Wiring

WIRING = Wiring(valves=(17, 18), return_line=22, alive_line=4, normally_open=True)
ALIVE = 0b1000
PWM = PwmLimits(frequency_hz=10.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)


class Lines(MemoryLines):
    """Memory that keeps what was written; `blind` cannot be read."""

    def __init__(self, levels: int = 0, *, blind: bool = False) -> None:
        super().__init__(levels)
        self.blind = blind
        self.written: list[int] = []

    def write(self, levels: int) -> None:
        self.written.append(levels)
        super().write(levels)

    def read(self) -> int | None:
        return None if self.blind else super().read()


class Clock:
    """Sleeps as long as it is told, and as much longer as `late` says for the nth time."""

    def __init__(self, late: Callable[[int], float] = lambda n: 0.0) -> None:
        self.now_s, self.naps, self.late = 100.0, 0, late

    def sleep(self, for_s: float) -> None:
        assert for_s == pytest.approx(WAKE_S)
        self.now_s += for_s + self.late(self.naps)
        self.naps += 1


def outcome(
    lines: MemoryLines, clock: Clock, *, wiring: Wiring = WIRING, late_max_s: float = 0.005
) -> SelfTest:
    return self_test(
        lines, wiring, late_max_s=late_max_s, clock=lambda: clock.now_s, sleep=clock.sleep
    )


def test_nothing_is_opened_and_alive_is_low_again() -> None:
    lines, clock = Lines(), Clock()
    found = outcome(lines, clock)
    safe = WIRING.safe_levels
    assert lines.written == [safe, safe | ALIVE, safe]
    assert (found.outputs, found.levels_read_back, found.alive_toggles) == (4, True, True)
    assert not found.fault
    assert (clock.naps, found.wakes) == (WAKES, WAKES)
    assert found.worst_late_s == pytest.approx(0.0, abs=1e-9)
    assert found.text().startswith("4 outputs, levels read back, ALIVE toggles, wake-ups")


def test_what_cannot_be_read_is_said_and_is_no_fault() -> None:
    lines = Lines(blind=True)
    found = outcome(lines, Clock())
    assert lines.written == [WIRING.safe_levels]
    assert (found.levels_read_back, found.alive_toggles, found.fault) == (None, None, "")
    assert "cannot be read back" in found.text()


def test_a_line_that_keeps_its_level_is_named_and_nothing_else_is_tried() -> None:
    lines, clock = Lines(), Clock()
    lines.stuck = 0b10
    found = outcome(lines, clock)
    assert found.fault == "outputs do not take their level: 18; see driver and wiring"
    assert (found.levels_read_back, found.alive_toggles, found.wakes) == (False, None, 0)
    assert math.isnan(found.p99_late_s)
    assert clock.naps == 0
    assert found.text() == f"failed: {found.fault}"


@pytest.mark.parametrize("level", [0, ALIVE])
def test_an_alive_line_that_stands_still_is_a_fault(level: int) -> None:
    lines = Lines(level | WIRING.safe_levels)
    lines.stuck = ALIVE
    assert "4" in outcome(lines, Clock()).fault


def test_an_alive_line_that_does_not_fall_is_a_fault() -> None:
    lines = Lines()
    write = lines.write

    def rises_only(levels: int) -> None:
        write(levels | lines.levels & ALIVE)

    lines.write = rises_only  # type: ignore[method-assign]
    found = outcome(lines, Clock())
    assert found.fault == "ALIVE does not toggle on line 4; see driver and wiring"
    assert found.alive_toggles is False


def test_a_device_that_is_gone_is_a_fault() -> None:
    lines = Lines()
    lines.broken = True
    found = outcome(lines, Clock())
    assert found.fault == "outputs cannot be driven: the device is gone"


def test_one_late_wake_up_in_a_hundred_is_allowed_and_two_are_not() -> None:
    once = outcome(Lines(), Clock(lambda n: 0.02 * (n == 7)))
    assert (once.fault, once.wakes) == ("", WAKES)
    assert once.worst_late_s == pytest.approx(0.02)
    assert once.p99_late_s == pytest.approx(0.0, abs=1e-9)
    clock = Clock(lambda n: 0.0074 * (n % WAKES in (7, 8)))
    twice = outcome(Lines(), clock)
    assert twice.fault == "wakes up 7.4 ms late; allow rtprio (docs/howto/wire-gpio.md)"
    assert clock.naps == ROUNDS * WAKES


def test_a_computer_that_calms_down_passes() -> None:
    clock = Clock(lambda n: 0.03 * (n < WAKES))
    found = outcome(Lines(), clock)
    assert (found.fault, clock.naps) == ("", 2 * WAKES)
    assert found.worst_late_s == pytest.approx(0.0, abs=1e-9)


def test_the_best_round_counts() -> None:
    clock = Clock(lambda n: (0.02, 0.01, 0.03)[n // WAKES])
    assert outcome(Lines(), clock).median_late_s == pytest.approx(0.01)


def test_it_passes_as_an_object() -> None:
    found = outcome(Lines(), Clock())
    assert SelfTest.from_object(found.as_object() | {"new": 1}) == found


def test_only_real_outputs_have_a_limit_of_their_own() -> None:
    limits = {
        backend: EngineSetup(wiring=WIRING, pwm=PWM, backend=backend).late_max_s  # type: ignore[arg-type]
        for backend in ("gpiod", "spi595", "memory", "file")
    }
    assert limits == {
        "gpiod": WAKE_LATE_MAX_S, "spi595": WAKE_LATE_MAX_S, "memory": math.inf, "file": math.inf,
    }  # fmt: skip
    with pytest.raises(ValueError, match="wake_late_max_s"):
        EngineSetup(wiring=WIRING, pwm=PWM, wake_late_max_s=math.nan)

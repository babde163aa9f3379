"""A method of one's own: loaded, flown inside the interlock, and ended in one line."""

from __future__ import annotations

import json
import math
import re
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from analysis.evaluation import evaluate
from companion.cli.app import execute
from companion.core.setup import Setup
from companion.core.types import HeartbeatReport, Input, SprayPlan, Telemetry, TimedChange
from sitl import own_method
from sitl.anyang import demo_lags, demo_setup, demo_trajectory
from sitl.flight import FlightOptions, FlightResult, fly
from sitl.outputs import PlanFollower
from sitl.own_method import (
    LEASE_S,
    Controller,
    ControllerError,
    Order,
    Seen,
    Sprayer,
    load_controller,
)
from sitl.profile import load_profile
from sitl.wang import LOOK_AHEAD_S, WangController, curve_duties

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "own-method"
PAGE = ROOT / "docs" / "howto" / "own-method.md"
Captured = pytest.CaptureFixture[str]
OPTIONS = FlightOptions(fidelity="averaged")


def setup() -> Setup:
    return replace(demo_setup(5.0), lag=demo_lags("gpio"))


def flown(own: Any, **more: Any) -> FlightResult:
    path = demo_trajectory(5.0, 1)
    return fly(setup(), path, load_profile("wang-2024"), OPTIONS, speed_m_s=5.0, own=own, **more)


class Full:
    """Orders every valve open, wherever it is."""

    def __init__(self, sprayer: Sprayer) -> None:
        self.count = len(sprayer.valves_right_m)

    def order(self, _seen: Seen) -> Sequence[float]:
        return (1.0,) * self.count


def test_the_fixed_lead_of_the_examples_hits_the_boundaries() -> None:
    result = flown(load_controller(f"{EXAMPLES / 'fixed_lead.py'}:FixedLead"))
    found = evaluate(result.record)
    assert found.meta.method == "FixedLead"
    assert found.missed == 0
    assert found.lag_distance_m.mean_abs is not None
    assert found.lag_distance_m.mean_abs < 0.15


def test_p1_written_as_an_example_flies_as_p1_emulated() -> None:
    own = evaluate(flown(load_controller(f"{EXAMPLES / 'wang2024.py'}:Wang2024")).record)
    wang = WangController(setup=setup(), look_ahead_s=LOOK_AHEAD_S, dose=curve_duties(setup()))
    emulated = evaluate(flown(None, wang=wang).record)
    # The emulated one polls by a clock of its own: a message is up to 50 ms old by then.
    assert own.lag_distance_m.mean == pytest.approx(emulated.lag_distance_m.mean, abs=0.25)
    assert own.misapplied_percent == pytest.approx(emulated.misapplied_percent, abs=0.7)
    assert own.applied_ml == pytest.approx(emulated.applied_ml, rel=0.01)


def without_heartbeats(items: Iterator[Input], after_s: float) -> Iterator[Input]:
    return (
        item for item in items if not isinstance(item, HeartbeatReport) or item.received_s < after_s
    )


def test_the_interlock_closes_whatever_is_ordered() -> None:
    start_s = float(demo_trajectory(5.0, 1).time_s[0])
    cut_s = start_s + 30.0
    result = flown(Full, disturb=lambda items: without_heartbeats(items, cut_s))
    opened = [each.at_s for each in result.record.orders if each.duty > 0.0]
    assert opened
    # Heartbeats come once a second, and the last of them is good for 2.5 s.
    assert max(opened) < cut_s + 3.0
    assert not any(at_duty(result.record.orders, cut_s + 3.0))
    assert "stale-heartbeat" in result.inhibits


def at_duty(orders: Sequence[TimedChange], at_s: float) -> list[float]:
    duty = [0.0] * 6
    for each in orders:
        if each.at_s <= at_s:
            duty[each.valve] = each.duty
    return duty


def test_nothing_is_sprayed_without_the_operators_consent() -> None:
    heartbeats_only = flown(
        Full, disturb=lambda items: (i for i in items if type(i).__name__ != "OperatorCommand")
    )
    assert heartbeats_only.record.orders == ()
    assert "not-enabled" in heartbeats_only.inhibits


def test_valves_close_where_no_position_follows() -> None:
    start_s = float(demo_trajectory(5.0, 1).time_s[0])

    def silent(items: Iterator[Input]) -> Iterator[Input]:
        return (i for i in items if not isinstance(i, Telemetry) or i.received_s < start_s + 20.0)

    orders = flown(Full, disturb=silent).record.orders
    assert any(at_duty(orders, start_s + 19.9))
    assert not any(at_duty(orders, start_s + 20.0 + LEASE_S + 0.1))


class Late:
    """Orders once for later, then what replaces it, then nothing."""

    def __init__(self, sprayer: Sprayer) -> None:
        self.count, self.calls = len(sprayer.valves_right_m), 0

    def order(self, seen: Seen) -> Order | None:
        if not seen.may_spray:
            return None
        self.calls += 1
        duty = {1: 0.5, 2: 0.7}.get(self.calls)
        return (
            None if duty is None else Order(duties=(duty,) * self.count, after_s=0.4 / self.calls)
        )


def test_an_order_for_later_is_kept_until_it_is_replaced() -> None:
    orders = flown(Late).record.orders
    assert {each.duty for each in orders[:6]} == {0.7}
    assert 0.5 not in {each.duty for each in orders}


@dataclass
class Valves:
    follower: PlanFollower = field(default_factory=lambda: PlanFollower(6))

    @property
    def orders(self) -> list[TimedChange]:
        return self.follower.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        self.follower.submit(plan, now_s=now_s)

    def finish(self, end_s: float) -> None:
        self.follower.advance(end_s)


def answers(answer: object) -> type[Controller]:
    class Once(Full):
        def order(self, seen: Seen) -> Any:
            super().order(seen)
            if seen.now_s < 130.0:
                return (1.0,) * 6
            if isinstance(answer, Exception):
                raise answer
            return answer

    return Once


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (RuntimeError("no idea"), r"RuntimeError: no idea \(test_own_method.py, line \d+\)"),
        ((0.5,) * 5, "5 duties ordered for 6 valves"),
        ((math.nan,) * 6, "a duty outside 0 to 1"),
        ((1.2,) * 6, "a duty outside 0 to 1"),
        (0.5, "TypeError"),
        (("a",) * 6, "ValueError"),
        (Order(duties=(0.5,) * 6, after_s=-1.0), "after_s is -1.0; give 0 to 10 s"),
        (Order(duties=(0.5,) * 6, after_s=math.nan), "after_s is nan"),
    ],
)
def test_a_method_that_fails_closes_the_valves_and_ends_in_one_line(
    answer: object, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    valves = Valves()
    monkeypatch.setattr("sitl.flight.sprayer", lambda *_: (None, valves))
    with pytest.raises(ControllerError, match=text) as caught:
        flown(answers(answer))
    assert re.search(
        r"\d+\.\d s after the start of the flight; all valves closed", str(caught.value)
    )
    assert "\n" not in str(caught.value)
    assert any(each.duty == 1.0 for each in valves.orders)
    assert valves.follower.duty == [0.0] * 6


LOOPS = """
class Swallows:
    def __init__(self, sprayer):
        {at_first}

    def order(self, seen):
        while True:
            try:
                len("round and round")
            except Exception:
                pass
"""


@pytest.mark.parametrize(
    ("at_first", "where"),
    [
        ("pass", "after the start of the flight; all valves closed"),
        ("\n        while True:\n            pass", "before the flight"),
    ],
)
def test_a_method_that_comes_to_no_answer_is_stopped_with_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_first: str, where: str
) -> None:
    monkeypatch.setattr(own_method, "ANSWER_MAX_S", 0.2)
    (tmp_path / "loops.py").write_text(LOOPS.format(at_first=at_first))
    name = f"{tmp_path / 'loops.py'}:Swallows"
    with pytest.raises(ControllerError, match=f"no answer within 0.2 s.*loops.py.*{where}"):
        flown(load_controller(name))
    assert signal.getitimer(signal.ITIMER_VIRTUAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGVTALRM) == signal.SIG_DFL


def test_a_class_that_cannot_be_made_is_one_line() -> None:
    class Bad(Full):
        def __init__(self, sprayer: Sprayer) -> None:
            raise KeyError("lead")

    with pytest.raises(ControllerError, match=r"Bad: KeyError: 'lead'.*before the flight"):
        flown(Bad)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mine", "give module:Class or file.py:Class"),
        ("mine:", "give module:Class or file.py:Class"),
        ("mine:A.b", "give module:Class or file.py:Class"),
        ("not_there:A", "ModuleNotFoundError: No module named 'not_there'"),
        ("not_there.py:A", "FileNotFoundError"),
        ("json:loads", r"no class with a method order\(self, seen\) loads in "),
        ("good.py:Other", "no class Other in .*good.py"),
        ("typo.py:A", "typo.py, line 1: "),
        ("raising.py:A", r"ZeroDivisionError: division by zero \(raising.py, line 2\)"),
        ("leaving.py:A", "SystemExit: 3"),
    ],
)
def test_what_cannot_be_loaded_is_one_line(
    name: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("good.py").write_text("class A:\n    def order(self, seen): ...\n")
    Path("typo.py").write_text("class A\n")
    Path("raising.py").write_text("\n1 / 0\n")
    Path("leaving.py").write_text("raise SystemExit(3)\n")
    with pytest.raises(ControllerError, match=text) as caught:
        load_controller(name)
    assert str(caught.value).startswith(f"--controller {name}: ")
    assert "\n" not in str(caught.value)


def test_the_ten_lines_of_the_page_fly_as_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured, two_passes: None,
    not_compared: None,
) -> None:  # fmt: skip
    page = PAGE.read_text()
    code = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[0]
    assert len(code.splitlines()) <= 10
    commands = re.findall(r"^vrspray .*--controller mine.*$", page, re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["demo", "sitl"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path("mine.py").write_text(code)
    assert execute(["examples", "copy", "anyang"]) == 0
    capsys.readouterr()
    assert execute([*commands[1].split()[1:], "--json"]) == 0
    flight = json.loads(capsys.readouterr().out)["flights"][0]
    assert (flight["method"], flight["missed"]) == ("FixedLead", 0)
    assert flight["lag_distance_m"]["mean_abs"] < 0.15
    assert sorted(path.name for path in Path("flown").iterdir()) == [
        "flight.png", "result.json", "truth.npz",
    ]  # fmt: skip
    monkeypatch.setattr("sitl.workers.PROCESSES_MAX", 1)  # as quick as two that import first
    monkeypatch.setattr("sitl.demo_cli.can_report", lambda: False)  # of the flight by our method
    assert execute([*commands[0].split()[1:], "--json"]) == 0
    flights = json.loads(capsys.readouterr().out)["flights"]
    assert [each["method"] for each in flights] == [
        "none", "look-ahead", "look-ahead-stated", "scheduled", "calibrated", "FixedLead",
    ]  # fmt: skip


def test_every_word_of_the_page_is_in_the_code() -> None:
    page = PAGE.read_text()
    tables = page.split("## What a method sees")[1].split("## What it orders")[0]
    words = [
        word for cell in re.findall(r"^\| (`.*?) \|", tables, re.MULTILINE)
        for word in re.findall(r"`(\w+)", cell) if word not in ("seen", "sprayer")
    ]  # fmt: skip
    known = set(Seen.__dataclass_fields__) | set(dir(Seen)) | set(dir(Sprayer(setup())))
    known |= set(vars(Sprayer(setup())))
    assert words
    assert [word for word in words if word not in known] == []

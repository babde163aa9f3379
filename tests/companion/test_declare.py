"""What the operator declares on the page: judged by the limits, on the ground, and recorded."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from analysis.report.legal_fields import told_in, told_with
from companion.cli.web_parts import Declarations
from companion.config import Config, load
from companion.core.estimator import Track, estimate, observe
from companion.core.inputs import (
    DeclarationReport,
    HeartbeatReport,
    Input,
    StandstillReport,
    UtcReport,
)
from companion.core.safety import Limits, inhibits
from companion.core.types import Inhibit
from companion.journal.journal import Journal
from companion.journal.reader import opened
from companion.link.service import Answer
from companion.web import Order, Outcome
from companion.web.page import parse_order
from tests.builders import SPRAYING, position, setup
from tests.companion.test_limits import EXAMPLE, HERE, NOW, config
from tests.companion.test_web_page import Wire

BOUNDS_M = (-1e3, -1e3, 1e3, 1e3)
LIMITS = (
    'wind_by = "operator"\nwind_max_m_s = 4\nwind_from_deg = [[260, 280]]\ntemperature_max_c = 25\n'
    'humidity_min_percent = 40\ninversion = "forbidden"\ndroplet_classes = ["coarse"]\n'
    "observed_max_h = 2\n"
)
KEPT: dict[str, str | float] = {
    "application.wind_m_s": 3.0, "application.wind_from_deg": 270.0,
    "application.temperature_c": 20.0, "application.humidity_percent": 60.0,
    "application.inversion": "no", "application.observed_at": "2026-05-01T05:00:00Z",
    "product.droplet_class": "coarse",
}  # fmt: skip
WEATHER = frozenset(reason for reason in Inhibit if reason.startswith("label-"))


class Bench:
    """A page's declarations, the component that takes them, and what the core makes of them."""

    def __init__(self, given: Config) -> None:
        self.config, self.wire = given, Wire()
        self.events: list[str] = []
        self.wire.component.on_event = lambda _at_s, _kind, text: self.events.append(text)
        self.declarations = Declarations(given, self)  # type: ignore[arg-type]
        self.inputs: list[Input] = []

    def declare(self, report: DeclarationReport) -> Answer:
        return self.wire.component.declare(report)

    def say(self, said: dict[str, Any]) -> Outcome:
        order = Order(number=1, name="declare", boot_s=0.0, said=tuple(said.items()))
        outcome = self.declarations.obey(order, 5.0)
        self.inputs += outcome.inputs
        return outcome

    def reasons(self, utc_s: float = NOW.timestamp()) -> set[Inhibit]:
        """Return which limits of the label keep a flight closed that keeps all others."""
        limits = self.config.limits()
        track = Track()
        for item in self.inputs:
            track = observe(track, item, setup(limits=limits))
        state = replace(HERE, declared=track.consent.declared, utc_offset_s=utc_s - 10.0)
        found = inhibits(state, limits, field_bounds_m=BOUNDS_M, now_s=10.0)
        return set(found & WEATHER)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(config(tmp_path, LIMITS))


def test_what_was_not_declared_before_the_start_opens_once_it_is_on_the_page(bench: Bench) -> None:
    assert bench.reasons() == {
        Inhibit.LABEL_WIND, Inhibit.LABEL_WIND_DIRECTION, Inhibit.LABEL_TEMPERATURE,
        Inhibit.LABEL_HUMIDITY, Inhibit.LABEL_INVERSION, Inhibit.LABEL_WEATHER_AGE,
        Inhibit.LABEL_DROPLETS,
    }  # fmt: skip
    outcome = bench.say(KEPT)
    assert (outcome.accepted, outcome.text) == (True, "declared, and kept")
    assert bench.reasons() == set()
    assert all(is_kept for *_, is_kept in bench.declarations.shown["rows"])
    assert "declared by page" in bench.events[0]


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("application.wind_m_s", 4.1, Inhibit.LABEL_WIND),
        ("application.wind_from_deg", 90.0, Inhibit.LABEL_WIND_DIRECTION),
        ("application.temperature_c", 26.0, Inhibit.LABEL_TEMPERATURE),
        ("application.humidity_percent", 39.0, Inhibit.LABEL_HUMIDITY),
        ("application.inversion", "yes", Inhibit.LABEL_INVERSION),
        ("product.droplet_class", "fine", Inhibit.LABEL_DROPLETS),
        ("application.observed_at", "2026-05-01T02:59:00Z", Inhibit.LABEL_WEATHER_AGE),
        ("application.observed_at", "2026-05-01T05:06:00Z", Inhibit.LABEL_WEATHER_AGE),
    ],
)
def test_what_is_declared_and_not_allowed_closes(
    bench: Bench, key: str, value: str | float, reason: Inhibit
) -> None:
    bench.say(KEPT)
    assert bench.say(KEPT | {key: value}).accepted
    assert bench.reasons() == {reason}
    bench.say(KEPT)
    assert bench.reasons() == set()


def test_a_declaration_ages_by_the_autopilots_clock(bench: Bench) -> None:
    bench.say(KEPT)
    assert bench.reasons(NOW.timestamp() + 7199.0) == set()
    assert bench.reasons(NOW.timestamp() + 7201.0) == {Inhibit.LABEL_WEATHER_AGE}


def test_older_weather_does_not_get_the_time_of_a_new_declaration(tmp_path: Path) -> None:
    words = [f"{key}={value}" for key, value in KEPT.items()]
    bench = Bench(config(tmp_path, LIMITS, *words))
    assert bench.reasons() == set()
    bench.say({name: KEPT[name] for name in ("application.wind_m_s", "application.observed_at")})
    # The temperature of the configuration was seen then; the droplets are no weather.
    assert Inhibit.LABEL_TEMPERATURE in bench.reasons()
    assert Inhibit.LABEL_DROPLETS not in bench.reasons()


@pytest.mark.parametrize(
    "said",
    [
        {"application.wind_m_s": 3.0},  # no time
        KEPT | {"application.wind_m_s": 61.0},
        KEPT | {"application.inversion": "perhaps"},
        KEPT | {"application.observed_at": "2026-02-30T05:00:00Z"},
        KEPT | {"application.observed_at": "2026-05-01T05:00:00"},  # of no zone
        KEPT | {"application.pilot": "somebody"},
        KEPT | {"safety.wind_max_m_s": 30.0},
    ],
)
def test_what_cannot_be_declared_changes_nothing(bench: Bench, said: dict[str, Any]) -> None:
    outcome = bench.say(said)
    assert not outcome.accepted
    assert "\n" not in outcome.text
    assert bench.inputs == []
    assert Inhibit.LABEL_TEMPERATURE in bench.reasons()


def test_nothing_is_declared_while_the_vehicle_is_armed(bench: Bench) -> None:
    desk = bench.wire.component._command_state
    desk.is_armed = True
    outcome = bench.say(KEPT)
    assert (outcome.accepted, outcome.inputs) == (False, ())
    assert "disarm" in outcome.text
    assert bench.declarations.shown["said"] == {}
    desk.is_armed, desk.is_open = False, True
    assert not bench.say(KEPT).accepted
    desk.is_open = False
    assert bench.say(KEPT).accepted


def test_without_limits_it_is_taken_down_for_the_record_only() -> None:
    bench = Bench(load(EXAMPLE))
    assert bench.say(KEPT).text == "declared, for the record"
    (report,) = bench.inputs
    assert isinstance(report, DeclarationReport)
    track = observe(Track(), report, setup(limits=Limits()))
    assert track.consent.declared is None  # no decision depends on it


def test_a_reason_that_nobody_knows_closes_too(bench: Bench) -> None:
    report = DeclarationReport(received_s=1.0, broken=("no such",), observed_s=None, said="{}")
    bench.inputs = [report]
    assert bench.reasons() == {Inhibit.LABEL_WEATHER_AGE}


def test_it_stays_over_a_standstill_and_reaches_the_state_without_its_words(bench: Bench) -> None:
    bench.say(KEPT)
    given = setup(limits=bench.config.limits())
    track = observe(Track(), bench.inputs[0], given)
    track = observe(track, StandstillReport(received_s=6.0, gap_s=5.0), given)
    for number in range(20):
        at_s = 8.1 + 0.1 * number
        track = observe(track, position(at_s, 5.0 * at_s, 3.0), given)
    state = estimate(track, 10.0)
    assert state is not None
    assert state.declared is not None
    assert (state.declared.broken, state.declared.said) == ((), "")


def test_the_time_of_day_is_asked_for_though_no_weather_was_declared_at_the_start(
    bench: Bench,
) -> None:
    given = setup(limits=bench.config.limits())
    assert observe(Track(), UtcReport(received_s=1.0, utc_s=1e9), given).utc is not None
    assert SPRAYING.declared is None


def test_an_order_carries_few_short_words_and_numbers() -> None:
    def order(said: object) -> Order | None:
        return parse_order(
            json.dumps({"number": 1, "name": "declare", "boot_s": 5.0, "said": said}).encode()
        )

    assert order(KEPT) == Order(number=1, name="declare", boot_s=5.0, said=tuple(KEPT.items()))
    wide = {f"key{number}": 1.0 for number in range(9)}
    for said in (wide, {"a": "x" * 61}, {"a": None}, {"a": True}, {"a": [1]}, {"a": 1e999}, "x"):
        assert order(said) is None, said


# ------------------------------------------------------------------------------------ the record


def test_the_journal_keeps_it_and_the_record_is_made_of_the_last_before_the_spraying_ended(
    tmp_path: Path,
) -> None:
    journal = Journal.create(
        tmp_path, setup=setup(), training="no",
        setup_text={"application_json": json.dumps({"application.temperature_c": 9.0})},
    )  # fmt: skip
    with journal:
        for at_s, wind_m_s in ((5.0, 2.0), (50.0, 3.0), (500.0, 9.0)):
            said = json.dumps(KEPT | {"application.wind_m_s": wind_m_s})
            journal.record_input(
                DeclarationReport(received_s=at_s, broken=(), observed_s=None, said=said)
            )
        journal.record_input(
            HeartbeatReport(received_s=600.0, autopilot="px4", armed=False, mode="AUTO")
        )
    with opened(journal.path) as read:
        meta = dict(read.meta)
    told = told_with(meta, until_s=100.0)
    assert told.values == KEPT
    assert told.after == frozenset()
    assert [at_s for at_s, _ in told.periods[1:]] == [5.0, 50.0]
    assert told_in(meta)["application.wind_m_s"] == 9.0
    assert told_in({**meta, "declared_json": "[[1"})["application.temperature_c"] == 9.0
    odd = json.dumps([[1.0, '{"application.pilot": 3, "application.wind_m_s": 1.0}'], [2.0, "[]"]])
    assert told_in({**meta, "declared_json": odd}) == {"application.wind_m_s": 1.0}

"""Another field from the operator's page: taken on the ground only, and never half."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from companion.cli.field_choice import (
    CHOSEN_NAME,
    PROPOSED_NAME,
    RESTART,
    RESTARTS,
    FieldChoice,
    no_choice,
    read_choice,
)
from companion.cli.output_parts import load_with_kept
from companion.config import load
from companion.core.controller import Memory, step
from companion.core.types import Decision
from companion.errors import ConfigError
from companion.web import Order
from tests import builders

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang"
FIELD = {"field": "0001-north", "settings": {"prescription.file": "north.gpkg"}}
NOW_S = 10.0


def decided(**change: Any) -> Decision:
    decision, _ = step(builders.setup(), builders.flying(NOW_S, 2.0, **change), Memory(), NOW_S)
    return decision


def on_ground(**change: Any) -> Decision:
    return decided(**{"armed": False, "in_air": False, **change})


def choice(
    folder: Path, decision: Decision | None, end: Callable[[], None], refusal: str = ""
) -> FieldChoice:
    return FieldChoice(folder=folder, refusal=refusal, newest=lambda: decision, end=end)


def order(name: str = "0001-north") -> Order:
    return Order(number=1, name="field", boot_s=0.0, said=(("field", name),))


def propose(folder: Path, content: Any = FIELD) -> None:
    (folder / PROPOSED_NAME).write_text(json.dumps(content))


def test_on_the_ground_a_proposal_is_kept_and_the_run_ends(tmp_path: Path) -> None:
    propose(tmp_path)
    ended: list[bool] = []
    outcome = choice(tmp_path, on_ground(), lambda: ended.append(True)).obey(order(), NOW_S)
    assert outcome.accepted
    assert ended == [True]
    assert read_choice(tmp_path / CHOSEN_NAME) == ("0001-north", ("prescription.file=north.gpkg",))
    again = choice(tmp_path, on_ground(), lambda: ended.append(True))
    assert again.obey(order(""), NOW_S).accepted
    assert ended == [True, True]
    assert read_choice(tmp_path / CHOSEN_NAME) == ("", ())


@pytest.mark.parametrize(
    ("decision", "now_s"),
    [
        pytest.param(None, NOW_S, id="no decision yet"),
        pytest.param(decided(armed=True, in_air=True), NOW_S, id="flying"),
        pytest.param(on_ground(armed=True), NOW_S, id="armed"),
        pytest.param(on_ground(in_air=True), NOW_S, id="in the air"),
        pytest.param(on_ground(heartbeat_received_s=None), NOW_S, id="never heard"),
        pytest.param(on_ground(), NOW_S + 3.0, id="no longer heard"),
        pytest.param(on_ground(heartbeat_received_s=float("nan")), NOW_S, id="no number"),
    ],
)
def test_nothing_is_taken_unless_the_vehicle_is_heard_on_the_ground_and_disarmed(
    tmp_path: Path, decision: Decision | None, now_s: float
) -> None:
    propose(tmp_path)
    for name in ("0001-north", ""):
        outcome = choice(tmp_path, decision, lambda: pytest.fail("ended")).obey(order(name), now_s)
        assert not outcome.accepted
    assert not (tmp_path / CHOSEN_NAME).exists()


@pytest.mark.parametrize(
    "content",
    [
        {**FIELD, "field": "0002-south"},
        {"field": "0001-north", "settings": {"safety.modes": "[]", "prescription.file": "a"}},
        {"field": "0001-north", "settings": {}},
        [],
    ],
)
def test_what_was_not_proposed_so_is_not_taken(tmp_path: Path, content: Any) -> None:
    propose(tmp_path, content)
    asked = choice(tmp_path, on_ground(), lambda: pytest.fail("ended"))
    assert not asked.obey(order(), NOW_S).accepted
    (tmp_path / PROPOSED_NAME).unlink()
    assert not asked.obey(order(), NOW_S).accepted
    assert not (tmp_path / CHOSEN_NAME).exists()


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights", "state"))
    (folder / "state").mkdir()
    (folder / "state" / CHOSEN_NAME).write_text(json.dumps(FIELD))
    return folder / "config.toml"


ALLOWED = ("web.enabled=true", "web.choose_field=true")


def test_only_a_configuration_that_says_so_flies_another_field(config_file: Path) -> None:
    own = load(config_file).prescription
    for words in ((), ALLOWED[:1], ALLOWED[1:]):
        config, given = load_with_kept(config_file, words)
        assert config.prescription == own
        assert given == words
    config, given = load_with_kept(config_file, ALLOWED)
    assert config.prescription is not None
    assert config.prescription.file == "north.gpkg"
    assert given == ("prescription.file=north.gpkg", *ALLOWED)
    config, _ = load_with_kept(config_file, (*ALLOWED, "prescription.file=typed.gpkg"))
    assert config.prescription is not None
    assert config.prescription.file == "typed.gpkg"


@pytest.mark.parametrize("content", ["", "{", '{"field": "a"}', '{"field": "a", "settings": {}}'])
def test_a_choice_that_cannot_be_read_is_refused_and_not_the_configurations_own(
    config_file: Path, content: str
) -> None:
    (config_file.parent / "state" / CHOSEN_NAME).write_text(content)
    with pytest.raises(ConfigError, match=r"^[^\n]*field\.json: [^\n]*delete it[^\n]*$"):
        load_with_kept(config_file, ALLOWED)


def test_a_choice_that_does_not_fit_is_said_with_its_file(config_file: Path) -> None:
    settings = {"prescription.file": "a.gpkg", "prescription.exclusions": "nonsense"}
    kept = config_file.parent / "state" / CHOSEN_NAME
    kept.write_text(json.dumps({"field": "a", "settings": settings}))
    with pytest.raises(ConfigError, match=r"field\.json: its values do not go"):
        load_with_kept(config_file, ALLOWED)


def test_a_field_is_chosen_where_the_owner_and_the_service_say_so(
    config_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load(config_file, overrides=ALLOWED)
    monkeypatch.delenv(RESTARTS, raising=False)
    assert "service" in no_choice(config, ALLOWED)
    monkeypatch.setenv(RESTARTS, str(RESTART))
    assert no_choice(config, ALLOWED) == ""
    assert "web.choose_field" in no_choice(load(config_file), ())
    assert "mission.lines=a" in no_choice(config, (*ALLOWED, "mission.lines=a"))

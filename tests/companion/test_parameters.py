"""Parameters over the wire: listed, read, set, kept, refused; and what becomes of them."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.cli.output_parts import build_link, load_with_kept
from companion.cli.run import component_options
from companion.core.types import RateOverride
from companion.errors import ConfigError, LinkError
from companion.link.component import Component, ComponentOptions
from companion.link.parameters import Parameters, known_parameters, read_state, write_state
from tests.companion.component_peer import OPEN, VEHICLE, Peer

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
LAGS = {
    "lag.on_s": 0.10,
    "lag.off_s": 0.08,
    "lag.up_s": 0.1,
    "lag.down_s": 0.1,
    "lag.position_s": 0.0,
}
REAL32 = 9


class Bench:
    """A component with parameters, and a ground station."""

    def __init__(self, *, armed: bool = False, save_works: bool = True) -> None:
        self.peer = Peer()
        self.saved: list[dict[str, float]] = []
        self.save_works = save_works
        self.component = Component(
            ComponentOptions(),
            self.peer.take,
            parameters=Parameters(known_parameters(LAGS), save=self.save),
        )
        mode = 128 if armed else 0
        self.component.receive(self.peer.autopilot("heartbeat", 2, 3, mode, 3, 4), 0.0)
        self.peer.sent.clear()

    def save(self, values: Any) -> bool:
        self.saved.append(dict(values))
        return self.save_works

    def set(self, name: str, value: float, *, kind: int = REAL32, to: int = 191) -> list[Any]:
        frame = self.peer.ground("param_set", VEHICLE, to, name.encode(), value, kind)
        return self.component.receive(frame, 1.0)

    def values(self) -> dict[str, float]:
        return {m.param_id: m.param_value for m in self.peer.of("PARAM_VALUE")}

    def texts(self) -> list[str]:
        self.component.tick(None, 50.0)
        return self.peer.texts()


@pytest.mark.parametrize("target", [(VEHICLE, 191), (VEHICLE, 0), (0, 0)])
def test_the_list_is_told_whole_in_order_and_paced(target: tuple[int, int]) -> None:
    bench = Bench()
    bench.component.receive(bench.peer.ground("param_request_list", *target), 1.0)
    per_turn = []
    for turn in range(60):
        before = len(bench.peer.of("PARAM_VALUE"))
        bench.component.tick(None, 1.0 + turn * 0.02)
        per_turn.append(len(bench.peer.of("PARAM_VALUE")) - before)
    told = bench.peer.of("PARAM_VALUE")
    assert max(per_turn) == 1
    assert [m.param_index for m in told] == list(range(8))
    assert {m.param_count for m in told} == {8}
    assert {m.param_type for m in told} == {REAL32}
    assert all(len(m.param_id) <= 16 for m in told)
    assert bench.values()["SPR_LAG_OFF"] == pytest.approx(0.08)


@pytest.mark.parametrize("target", [(VEHICLE, 1), (8, 191), (8, 0)])
def test_a_list_that_is_asked_of_others_is_not_told(target: tuple[int, int]) -> None:
    bench = Bench()
    bench.component.receive(bench.peer.ground("param_request_list", *target), 1.0)
    for turn in range(20):
        bench.component.tick(None, 1.0 + turn * 0.1)
    assert not bench.values()


def test_lists_asked_for_without_end_wait_in_no_queue() -> None:
    bench = Bench()
    for _ in range(1000):
        bench.component.receive(bench.peer.ground("param_request_list", VEHICLE, 191), 1.0)
    for turn in range(100):
        bench.component.tick(None, 1.0 + turn * 0.1)
    assert len(bench.peer.of("PARAM_VALUE")) == 8


def test_one_is_read_by_name_or_by_index() -> None:
    bench = Bench()
    for name, index in [(b"SPR_LAG_ON", -1), (b"", 0), (b"ignored", 1)]:
        bench.component.receive(
            bench.peer.ground("param_request_read", VEHICLE, 191, name, index), 1.0
        )
    assert list(bench.values()) == ["SPR_LAG_ON", "SPR_RATE_PCT", "SPR_VAL_HZ"]
    bench.peer.sent.clear()
    for name, index in [(b"SERVO9_FUNCTION", -1), (b"", 8), (b"", 32767), (b"\xff\xfe", -1)]:
        bench.component.receive(
            bench.peer.ground("param_request_read", VEHICLE, 191, name, index), 1.0
        )
    assert not bench.values()


def test_a_lag_is_kept_for_the_next_start() -> None:
    bench = Bench()
    assert bench.set("SPR_LAG_ON", 0.12) == []
    assert bench.saved == [{"SPR_LAG_ON": 0.12}]
    assert bench.values() == {"SPR_LAG_ON": pytest.approx(0.12)}
    assert bench.texts() == ["Spray: SPR_LAG_ON 0.12, at next start"]


def test_a_lag_is_refused_while_armed_and_the_old_one_told() -> None:
    bench = Bench(armed=True)
    bench.set("SPR_LAG_ON", 0.12)
    assert not bench.saved
    assert bench.values() == {"SPR_LAG_ON": pytest.approx(0.10)}
    assert bench.texts() == ["Spray: SPR_LAG_ON: disarm first"]


def test_a_lag_is_refused_while_a_valve_may_be_open() -> None:
    bench = Bench()
    bench.component.tick(OPEN, 0.5)
    bench.set("SPR_LAG_ON", 0.12)
    assert not bench.saved


def test_the_rate_may_be_set_in_flight_and_is_not_kept() -> None:
    bench = Bench(armed=True)
    assert bench.set("SPR_RATE_PCT", 90.0) == [RateOverride(received_s=1.0, percent=90.0)]
    assert bench.set("SPR_RATE_PCT", 111.0) == []
    assert not bench.saved
    assert [m.param_value for m in bench.peer.of("PARAM_VALUE")] == [90.0, 90.0]


@pytest.mark.parametrize("value", [-0.01, 30.1, float("nan"), float("inf"), -float("inf")])
def test_values_out_of_range_are_refused(value: float) -> None:
    bench = Bench()
    bench.set("SPR_LAG_ON", value)
    assert not bench.saved
    assert bench.values() == {"SPR_LAG_ON": pytest.approx(0.10)}


def test_another_type_than_real32_is_refused() -> None:
    bench = Bench()
    bits = struct.unpack("<f", struct.pack("<i", 90))[0]
    assert bench.set("SPR_RATE_PCT", bits, kind=6) == []
    assert bench.set("SPR_RATE_PCT", 90.0, kind=6) == []
    assert [m.param_value for m in bench.peer.of("PARAM_VALUE")] == [100.0, 100.0]


@pytest.mark.parametrize(("name", "to"), [("SPR_NOPE", 191), ("SPR_LAG_ON", 1), ("SPR_LAG_ON", 0)])
def test_what_is_not_ours_is_neither_set_nor_answered(name: str, to: int) -> None:
    bench = Bench()
    bench.set(name, 0.2, to=to)
    assert not bench.saved
    assert not bench.values()


def test_a_value_that_cannot_be_stored_is_not_taken() -> None:
    bench = Bench(save_works=False)
    bench.set("SPR_LAG_ON", 0.12)
    assert bench.values() == {"SPR_LAG_ON": pytest.approx(0.10)}


def test_the_rate_of_the_values_acts_at_once() -> None:
    bench = Bench()
    bench.set("SPR_VAL_HZ", 5.0)
    for turn in range(100):
        bench.component.tick(OPEN, 100.0 + turn * 0.05)
    assert len(bench.peer.named("SPR_STATE")) == 25


@given(
    wanted=st.lists(
        st.tuples(
            st.sampled_from([*(f"SPR_LAG_{n}" for n in ("ON", "POS")), "SPR_RATE_PCT", "SPR_X"]),
            st.floats(width=32),
        ),
        max_size=8,
    )
)
def test_whatever_is_set_every_value_stays_in_its_range(wanted: list[tuple[str, float]]) -> None:
    known = known_parameters(LAGS)
    parameters = Parameters(known)
    for name, value in wanted:
        if parameters.index(name) is not None:
            parameters.set(name, value, is_frozen=False)
    for one in known:
        assert one.low <= parameters.get(one.name, float("nan")) <= one.high


# ------------------------------------------------------------------------------------ state file


def test_a_state_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "state" / "parameters.json"
    assert read_state(path) == {}
    assert write_state(path, {"A": 0.1})
    assert write_state(path, {"B": 2.0})
    assert read_state(path) == {"B": 2.0}
    assert [one.name for one in path.parent.iterdir()] == ["parameters.json"]


def test_a_folder_that_cannot_be_made_is_no_exception(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    assert not write_state(tmp_path / "state" / "parameters.json", {"A": 0.1})


@pytest.mark.parametrize(
    "content", ["", "{", "[1]", '{"A": "x"}', '{"A": true}', '{"A": NaN}', '{"A": 1e400}', "\udc80"]
)
def test_a_damaged_state_file_is_said_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "parameters.json"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(LinkError, match=r"^[^\n]*delete it[^\n]*$"):
        read_state(path)


# --------------------------------------------------------------------------------- configuration


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights", "state"))
    return folder / "config.toml"


def test_a_kept_lag_is_the_next_start_s(config_file: Path) -> None:
    config, given_ = load_with_kept(config_file, ["output.kind=none"])
    before_s = config.lag.on_s
    assert given_ == ("output.kind=none",)
    link = build_link(config, given_, component_options(config))
    peer = Peer()
    frame = peer.ground("param_set", 1, 191, b"SPR_LAG_ON", before_s + 0.03, REAL32)
    link.component.receive(frame, 1.0)
    state = config_file.parent / "state" / "parameters.json"
    assert json.loads(state.read_text()) == {"SPR_LAG_ON": pytest.approx(before_s + 0.03)}
    after, given_ = load_with_kept(config_file, ["output.kind=none"])
    assert after.lag.on_s == pytest.approx(before_s + 0.03)
    assert given_[0].startswith("lag.on_s=")
    over, _ = load_with_kept(config_file, ["lag.on_s=0.5"])
    assert over.lag.on_s == 0.5


def test_a_lag_that_contradicts_the_others_is_refused(config_file: Path) -> None:
    config, given_ = load_with_kept(config_file, [])
    link = build_link(config, given_, component_options(config))
    link.component.receive(
        Peer().ground("param_set", 1, 191, b"SPR_LAG_ON", 0.0, REAL32), 1.0
    )  # below lag.on_start_s
    assert not (config_file.parent / "state").exists()


def test_kept_values_that_no_longer_fit_are_said_in_one_line(config_file: Path) -> None:
    state = config_file.parent / "state" / "parameters.json"
    write_state(state, {"SPR_LAG_ON": 0.0})
    with pytest.raises(ConfigError, match=r"^[^\n]*parameters\.json: [^\n]*delete it[^\n]*$"):
        load_with_kept(config_file, [])

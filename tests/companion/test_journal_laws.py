"""Laws of the journal: nothing is changed by writing it, no damage does more than damage."""

from __future__ import annotations

import dataclasses
import math
import shutil
import struct
import tempfile
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.journals.content import read_journal
from companion.core.controller import Memory, step
from companion.core.schedule import LagModel
from companion.core.types import (
    Decision,
    Inhibit,
    Input,
    SprayPlan,
    TimedChange,
    VehicleState,
)
from companion.errors import JournalError
from companion.journal.codec import FIELD_NAMES, decode, encode
from companion.journal.journal import Journal, open_for_flight
from companion.journal.writer import Writer
from tests.builders import flying, setup


def any_of(kind: type) -> st.SearchStrategy[Any]:
    """Return values of a dataclass without checks: every field whatever its type allows."""
    hints = get_type_hints(kind)
    return st.builds(
        kind, **{name: st.from_type(hints[name]) for name in FIELD_NAMES[kind.__name__]}
    )


@st.composite
def plans(draw: st.DrawFn) -> SprayPlan:
    valves = draw(st.integers(1, 4))
    shares = st.floats(0.0, 1.0)
    times = sorted(draw(st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=4)))
    issued_s = draw(st.floats(-1e9, 1e9))
    return SprayPlan(
        sequence=draw(st.integers(0, 2**62)),
        issued_s=issued_s,
        duty=tuple(draw(shares) for _ in range(valves)),
        changes=tuple(
            TimedChange(
                at_s=at_s,
                valve=draw(st.integers(0, valves - 1)),
                duty=draw(shares),
                restart=draw(st.booleans()),
            )
            for at_s in times
        ),
        lease_until_s=issued_s + 0.3,
    )


@st.composite
def all_decisions(draw: st.DrawFn) -> Decision:
    return Decision(
        now_s=draw(st.floats()),
        state=draw(st.none() | any_of(VehicleState)),
        inhibits=draw(st.frozensets(st.sampled_from(Inhibit))),
        plan=draw(plans()),
        rate_l_ha=tuple(draw(st.lists(st.none() | st.floats(), max_size=4))),
        target_flow_l_min=draw(st.floats()),
        flow_l_min=draw(st.floats()),
        late_count=draw(st.integers(0, 9)),
        unresolved_count=draw(st.integers(0, 9)),
    )


def bits(value: Any) -> Any:
    """Return what two values have in common only if they are the same to the last bit."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else struct.pack("<d", value)
    if isinstance(value, tuple):
        return [bits(item) for item in value]
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return type(value), [bits(getattr(value, name)) for name in names]
    return type(value), value


@given(item=st.one_of([any_of(kind) for kind in get_args(Input)]))
def test_every_input_is_read_back_to_the_last_bit(item: Input) -> None:
    assert bits(decode(encode(item))) == bits(item)


@given(decision=all_decisions())
def test_every_decision_is_read_back_to_the_last_bit(decision: Decision) -> None:
    assert bits(decode(encode(decision))) == bits(decision)


@given(text=st.text(max_size=60) | st.sampled_from(["{}", '{"Fix":99}', '{"Setup":[1]}', "[[["]))
def test_any_text_is_decoded_or_refused(text: str) -> None:
    with suppress(ValueError):
        decode(text)


@pytest.fixture(scope="module")
def crashed() -> Any:
    """Yield a folder with a journal whose log was never folded in: five commits of ten rows."""
    with tempfile.TemporaryDirectory() as folder:
        with Journal.create(Path(folder) / "live", setup=setup()) as journal:
            pass
        connection = open_for_flight(journal.path)
        writer = Writer(
            connection, frame=setup().frame, utc_offset_s=0.0, next_sequence=count(1).__next__
        )
        memory = Memory()
        for i in range(50):
            now_s = 10.0 + i / 20
            decision, memory = step(setup(), flying(now_s, east_m=1.0 + i / 4), memory, now_s)
            writer.write(i + 1, decision)
            if i % 10 == 9:
                writer.commit(lost_before=0)
        shutil.copytree(journal.path.parent, Path(folder) / "left")
        connection.close()
        yield Path(folder) / "left"


@settings(max_examples=25)
@given(share=st.floats(0.0, 1.0))
def test_a_log_cut_anywhere_leaves_whole_commits(crashed: Path, share: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(crashed, Path(folder) / "copy")
        log = copy / "flight-0001.gpkg-wal"
        with log.open("r+b") as file:
            file.truncate(int(log.stat().st_size * share))
        content = read_journal(copy / "flight-0001.gpkg")
        assert [entry.sequence for entry in content.entries] == list(
            range(1, len(content.entries) + 1)
        )
        assert len(content.entries) % 10 == 0
        assert share < 1.0 or len(content.entries) == 50


@settings(max_examples=25)
@given(share=st.floats(0.0, 0.999), junk=st.binary(min_size=1, max_size=300), log=st.booleans())
def test_junk_anywhere_is_read_or_refused_in_one_line(
    crashed: Path, share: float, junk: bytes, log: bool
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(crashed, Path(folder) / "copy")
        path = copy / "flight-0001.gpkg"
        target = copy / "flight-0001.gpkg-wal" if log else path
        with target.open("r+b") as file:
            file.seek(int(target.stat().st_size * share))
            file.write(junk)
        try:
            list(read_journal(path).items())
        except JournalError as refusal:
            assert "\n" not in str(refusal)


@settings(max_examples=8)
@given(
    values=st.tuples(*[st.floats(0.0, 10.0)] * 6),
    position_s=st.floats(-0.5, 0.5),
)
def test_every_lag_of_a_set_up_is_read_back_to_the_last_bit(
    values: tuple[float, ...], position_s: float
) -> None:
    on, off, up, down, output, extra = values
    lag = LagModel(
        on_s=on,
        off_s=off,
        up_s=up,
        down_s=down,
        on_start_s=on / 3,
        off_end_s=off + extra,
        output_s=output,
        position_s=position_s,
    )
    with tempfile.TemporaryDirectory() as folder:
        with Journal.create(Path(folder), setup=setup(lag=lag)) as journal:
            pass
        assert bits(read_journal(journal.path).setup.lag) == bits(lag)

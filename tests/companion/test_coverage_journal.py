"""Treated ground on the disk, in another frame, and for the flight that goes on."""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import closing
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from analysis.flown.read_applied import read_applied
from analysis.journals.content import read_journal
from analysis.replay import replay
from companion.cli.app import execute
from companion.core.controller import Memory, expected_coverage, step
from companion.core.estimator import Track, estimate, observe
from companion.core.frame import LocalFrame
from companion.core.options.coverage import Coverage
from companion.core.options.overlap import OverlapGuard
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    OperatorCommand,
    Telemetry,
)
from companion.errors import JournalError
from companion.journal.continuing import (
    SWITCH_OFF_PERCENT,
    continued,
    is_journal,
    read_treated_ground,
    rest_of,
    treated_by,
    unfinished,
)
from companion.journal.coverage import (
    moved,
    polygons,
    read_coverage,
    read_treated,
)
from companion.journal.journal import Journal
from companion.journal.writer import write_coverage, write_treated
from companion.runtime import coverage_ahead_s
from tests.builders import setup

FRAME = LocalFrame(36.0, 114.5)


def ground(west: float, south: float, east: float, north: float) -> Coverage:
    return Coverage().stamped([((west, south), (east, south), (east, north), (west, north))])


# ------------------------------------------------------------------------------ in the database


@pytest.fixture
def database() -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    connection.execute("CREATE TABLE meta (id INTEGER PRIMARY KEY, key TEXT UNIQUE, value TEXT)")
    connection.execute(
        "CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT, "
        "identifier TEXT, description TEXT)"
    )
    yield connection
    connection.close()


def test_what_is_written_is_read_back(database: sqlite3.Connection) -> None:
    made = replace(ground(-20.0, -3.0, 70.0, 3.0), ahead_s=0.55)
    write_coverage(database, made, None)
    assert read_coverage(database) == made
    assert read_treated(database) is None


def test_only_tiles_that_changed_are_written_and_those_that_went_are_dropped(
    database: sqlite3.Connection,
) -> None:
    first = ground(0.0, 0.0, 60.0, 6.0)
    write_coverage(database, first, None)
    before = database.total_changes
    foreseen = first.stamped([((60.0, 0.0), (70.0, 0.0), (70.0, 6.0), (60.0, 6.0))])
    write_coverage(database, foreseen, first)
    # The tile where it goes on, the next one, and how far ahead it is.
    assert database.total_changes - before == 3
    write_coverage(database, first, foreseen)
    assert read_coverage(database) == first


def test_before_a_flight_and_after_it_are_kept_apart(database: sqlite3.Connection) -> None:
    before, own = ground(0.0, 0.0, 30.0, 6.0), ground(30.0, 0.0, 60.0, 6.0)
    write_treated(database, before)
    write_coverage(database, own, None)
    assert read_treated(database) == before
    assert read_coverage(database) == before.joined(own)


def test_a_journal_without_coverage_says_so(database: sqlite3.Connection) -> None:
    assert read_coverage(database) is None
    write_treated(database, None)
    assert read_coverage(database) is None


@pytest.mark.parametrize(
    "cells",
    [b"", b"no zlib", zlib.compress(b"short"), zlib.compress(bytes(10_000)), "text", None],
)
def test_a_damaged_tile_is_told_and_not_taken(database: sqlite3.Connection, cells: object) -> None:
    write_coverage(database, ground(0.0, 0.0, 2.0, 2.0), None)
    database.execute("PRAGMA ignore_check_constraints = ON")
    database.execute("UPDATE coverage_tiles SET cells = ?", (cells or b"",))
    with pytest.raises(ValueError, match="damaged"):
        read_coverage(database)


def test_a_tile_from_nowhere_is_told(database: sqlite3.Connection) -> None:
    write_coverage(database, ground(0.0, 0.0, 2.0, 2.0), None)
    database.execute("UPDATE coverage_tiles SET tile_east = 99999999999")
    with pytest.raises(ValueError, match="tile at"):
        read_coverage(database)


# --------------------------------------------------------------------------------- as an area


def test_the_outline_of_cells_is_their_ground() -> None:
    made = ground(0.0, 0.0, 30.0, 6.0).joined(ground(10.0, 20.0, 12.0, 22.0))
    area = polygons(made)
    assert area.area == pytest.approx(made.area_m2, rel=1e-4)
    assert len(area.geoms) == 2
    assert area.bounds == pytest.approx((0.0, 0.0, 30.0, 22.0), abs=1e-3)
    assert polygons(Coverage()).is_empty


def test_a_coverage_moves_to_another_frame_with_its_ground() -> None:
    made = ground(-40.0, 10.0, 50.0, 16.0)
    there = LocalFrame(36.002, 114.503)
    carried = moved(made, FRAME, there)
    assert carried.area_m2 == pytest.approx(made.area_m2, rel=0.01)
    for place, is_treated in (((-39.0, 15.0), True), ((49.0, 11.0), True), ((51.0, 13.0), False)):
        east, north = there.to_local(*FRAME.to_geographic(*place))
        assert carried.covered_at(np.array([east]), np.array([north])).all() == is_treated
    assert moved(made, FRAME, LocalFrame(36.0, 114.5)) is made


def test_what_is_left_has_no_pieces_that_no_valve_is_for() -> None:
    field = shapely.box(0.0, 0.0, 100.0, 30.0)
    # A margin of 0.3 m at both ends and along the border, 0.1 m between two passes.
    made = ground(0.3, 0.3, 99.7, 6.0).joined(ground(0.3, 6.2, 99.7, 12.0))
    left = rest_of(field, made, 1.0)
    assert left.bounds == pytest.approx((0.0, 12.0, 100.0, 30.0), abs=0.3)
    assert left.area == pytest.approx(100.0 * 18.0, rel=0.02)
    assert rest_of(field, ground(0.0, 0.0, 100.0, 30.0), 1.0).is_empty


# -------------------------------------------------------------------------------- in a journal


def inputs(until_s: float) -> Iterator[Any]:
    yield OperatorCommand(received_s=10.0, enable=True, source="command")
    for i in range(round((until_s - 10.0) * 20.0)):
        now = 10.0 + i / 20.0
        if i % 10 == 0:
            yield HeartbeatReport(received_s=now, autopilot="ardupilot", armed=True, mode="AUTO")
            yield GnssReport(received_s=now, fix=Fix.RTK_FIXED)
            yield EstimatorReport(received_s=now, healthy=True)
            yield LandedReport(received_s=now, in_air=True)
        yield position(now, -10.0 + 0.25 * i)


def position(received_s: float, east_m: float) -> Telemetry:
    latitude, longitude = FRAME.to_geographic(east_m, 3.0)
    return Telemetry(
        received_s=received_s, boot_s=received_s, latitude_deg=latitude, longitude_deg=longitude,
        relative_altitude_m=3.5, velocity_north_m_s=0.0, velocity_east_m_s=5.0,
        velocity_down_m_s=0.0, heading_deg=90.0,
    )  # fmt: skip


def journal(folder: Path, own: Setup, until_s: float = 17.0, **how: Any) -> Path:
    """Fly east over the field of the builders until a time, and write the journal of it."""
    track, memory = Track(), Memory()
    how.setdefault("training", "no")
    with Journal.create(folder, setup=own, started_s=10.0, waits=True, **how) as made:
        for item in inputs(until_s):
            made.record_input(item)
            track = observe(track, item, own)
            now_s = item.received_s
            decision: Decision
            decision, memory = step(own, estimate(track, now_s), memory, now_s)
            made.record_decision(decision)
            if memory.watched.area is not None:
                made.record_coverage(memory.watched.area.coverage)
        return made.path


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The journal of a flight over a part of the field."""
    return journal(tmp_path_factory.mktemp("first"), setup(record_coverage=True))


@pytest.fixture(scope="module")
def second(first: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The journal of the flight that went on."""
    onward = continued(setup(), [first])
    return journal(tmp_path_factory.mktemp("second"), onward, until_s=22.0)


def test_a_flight_goes_on_where_another_ended_and_its_replay_agrees(
    first: Path, second: Path
) -> None:
    found = read_treated_ground(first)
    assert found.coverage.area_m2 == pytest.approx(6.0 * 20.0, abs=15.0)
    assert found.stopped is not None
    east_m, north_m = FRAME.to_local(*found.stopped)
    assert (north_m, east_m) == (pytest.approx(3.0, abs=0.2), pytest.approx(24.7, abs=0.5))

    onward = continued(setup(), [first])
    assert onward.overlap == OverlapGuard(switch_off_percent=SWITCH_OFF_PERCENT)
    assert onward.treated is not None
    assert onward.treated.tiles == found.coverage.tiles
    kept = read_journal(second).setup
    assert (kept.treated, kept.overlap) == (onward.treated, onward.overlap)
    opened = [
        item
        for item in read_journal(second).items()
        if isinstance(item, Decision) and any(item.plan.duty)
    ]
    assert opened
    assert all(item.state is not None and item.state.east_m > 15.0 for item in opened)
    result = replay(second)
    assert (result.decisions > 100, result.differences) == (True, 0)
    whole = read_treated_ground(second).coverage
    assert whole.area_m2 == pytest.approx(6.0 * 48.0, abs=8.0)


def test_a_configured_percentage_stays_and_nothing_to_go_on_changes_nothing(first: Path) -> None:
    own = setup(overlap=OverlapGuard(switch_off_percent=80.0))
    assert continued(own, []) is own
    assert continued(own, [first]).overlap == own.overlap
    # Nobody chose that of a plan's lines: lines flown again would stay half open.
    half = OverlapGuard(switch_off_percent=SWITCH_OFF_PERCENT)
    assert continued(own, [first], by_default=True).overlap == half


def test_a_flight_with_water_treats_nothing_for_one_with_a_product(tmp_path: Path) -> None:
    path = journal(tmp_path, setup(record_coverage=True), until_s=15.0, training="water")
    with pytest.raises(JournalError, match="training = water"):
        treated_by([path], FRAME)
    assert treated_by([path], FRAME, training="water").area_m2 > 0.0


@pytest.mark.parametrize("training", ["simulated", "dry"])
def test_what_sprayed_no_product_is_no_ground_to_go_on_from(tmp_path: Path, training: str) -> None:
    path = journal(tmp_path, setup(record_coverage=True), until_s=15.0, training=training)
    with pytest.raises(JournalError, match=f"training = {training}"):
        continued(setup(), [path])


def test_what_says_nothing_of_it_needs_somebody_who_does(tmp_path: Path) -> None:
    path = journal(tmp_path, setup(record_coverage=True), until_s=15.0, training=None)
    with pytest.raises(JournalError, match="--continue-unmarked"):
        continued(setup(), [path])
    assert continued(setup(), [path], takes_unmarked=True).treated is not None


def test_a_flight_that_left_ground_is_named(first: Path, second: Path) -> None:
    own = setup(record_coverage=True)
    with_map = replace(own, prescription=copy(own.prescription))
    with_map.prescription.sha256 = "a" * 64
    assert unfinished(first.parent, own) is None  # a map without a hash is not known again
    journal(first.parent, replace(with_map, record_coverage=True), until_s=15.0)
    found = unfinished(first.parent, with_map)
    assert found is not None
    assert found.path.name == "flight-0002.gpkg"
    assert found.left_share > 0.5
    # Later flights with water, or that treated nothing, hide nothing.
    journal(first.parent, with_map, until_s=15.0, training="water")
    journal(first.parent, with_map, until_s=10.5)
    assert unfinished(first.parent, with_map) == found
    assert unfinished(first.parent, with_map, training="dry") is None
    assert unfinished(first.parent / "absent", with_map) is None
    (first.parent / "flight-0099.gpkg").write_text("no database")
    assert unfinished(first.parent, with_map) == found


def test_a_replay_proves_the_treated_ground(first: Path, tmp_path: Path) -> None:
    assert replay(first).coverage_differs == 0
    path = tmp_path / "other.gpkg"
    path.write_bytes(first.read_bytes())
    with closing(sqlite3.connect(path)) as connection, connection:
        kept = read_coverage(connection)
        assert kept is not None
        write_coverage(connection, kept.joined(ground(30.0, 20.0, 34.0, 22.0)), kept)
    result = replay(path)
    assert (result.differences, result.coverage_differs) == (0, 200)
    assert execute(["replay", str(path)]) == 1


def test_a_replay_of_a_cut_flight_compares_what_was_to_be(tmp_path: Path) -> None:
    own = setup(record_coverage=True)
    track, memory, told_s = Track(), Memory(), -math.inf
    with Journal.create(tmp_path, setup=own, started_s=10.0, waits=True) as made:
        for item in inputs(17.0):
            made.record_input(item)
            track = observe(track, item, own)
            now_s, state = item.received_s, estimate(track, item.received_s)
            decision, memory = step(own, state, memory, now_s)
            made.record_decision(decision)
            if now_s >= told_s + 0.1:
                told_s = now_s
                cut_s = now_s + coverage_ahead_s(1.0)
                made.record_coverage(
                    expected_coverage(own, memory, state, now_s=now_s, cut_s=cut_s)
                )
    with closing(sqlite3.connect(made.path)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'recovered' WHERE key = 'closed'")
    assert replay(made.path).coverage_differs == 0
    with closing(sqlite3.connect(made.path)) as connection, connection:
        connection.execute("DELETE FROM coverage_tiles WHERE tile_east = 0")
    assert (replay(made.path).coverage_differs or 0) > 100


def test_a_replay_without_treated_ground_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = journal(tmp_path, setup(), until_s=11.0)
    assert replay(path).coverage_differs is None
    assert execute(["replay", str(path)]) == 0
    assert "not compared" in capsys.readouterr().err


def damaged(first: Path, folder: Path) -> Path:
    """A copy whose treated ground has one tile that cannot be read."""
    path = folder / "damaged.gpkg"
    path.write_bytes(first.read_bytes())
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE coverage_tiles SET cells = x'00' WHERE id = 1")
    return path


def test_of_a_damaged_journal_is_told_what_can_be_read(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = damaged(first, tmp_path)
    assert execute(["flights", "remaining", str(path), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert "1 of 2 tiles are damaged" in found["unread"][0]
    assert not found["is_exact"]
    # Nobody goes on from it: what is not read would be sprayed twice.
    with pytest.raises(JournalError, match="is damaged"):
        continued(setup(), [path])
    assert execute(["replay", str(path), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["unread"]


def test_without_the_treated_ground_the_rest_of_a_journal_is_read(
    first: Path, tmp_path: Path
) -> None:
    path = tmp_path / first.name
    with closing(sqlite3.connect(first)) as connection:
        # The table and its index.
        sql = "SELECT rootpage FROM sqlite_master WHERE tbl_name = 'coverage_tiles'"
        pages = [page for (page,) in connection.execute(sql) if page]
        ((size,),) = connection.execute("PRAGMA page_size").fetchall()
    damaged = bytearray(first.read_bytes())
    for page in pages:
        damaged[(page - 1) * size : page * size] = bytes(size)
    path.write_bytes(damaged)
    unread: list[str] = []
    flight = read_applied(path, unread=unread)
    assert flight.changes.duty.tolist() == read_applied(first).changes.duty.tolist()
    assert sum(text.startswith("treated ground") for text in unread) == 1
    assert read_journal(path, is_lenient=True).entries == read_journal(first).entries
    with pytest.raises(JournalError, match="damaged"):
        read_treated_ground(path)


def test_of_a_damaged_set_up_nothing_can_be_told_in_one_line(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "damaged.gpkg"
    path.write_bytes(first.read_bytes())
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE meta SET value = '{' WHERE key = 'setup'")
    for command in (["flights", "remaining"], ["replay"]):
        assert execute([*command, str(path), "--json"]) == 1
        said = capsys.readouterr()
        assert "is damaged" in json.loads(said.out)["error"]
        assert len(said.err.splitlines()) == 1


def test_a_journal_that_kept_no_coverage_is_refused(tmp_path: Path) -> None:
    path = journal(tmp_path, setup(), until_s=11.0)
    with pytest.raises(JournalError, match="keeps no treated ground"):
        read_treated_ground(path)


def test_a_journal_is_told_from_a_map(tmp_path: Path) -> None:
    path = journal(tmp_path, setup(), until_s=10.5)
    assert is_journal(path)
    text = tmp_path / "other.gpkg"
    text.write_text("no database")
    assert not is_journal(text)
    assert not is_journal(tmp_path / "absent.gpkg")


# ---------------------------------------------------------------------------------- commands


def remaining(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert execute(["flights", "remaining", *arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_what_is_left_is_told_in_hectares_and_litres(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rest.geojson"
    found = remaining(capsys, str(first), "--out", str(out))
    treated_m2 = 1e4 * found["treated_ha"]
    assert found["field_ha"] == pytest.approx(48.0 * 8.0 / 1e4)
    # The boom is 6 m wide, the field 8 m: its two edges of 1 m have no rate.
    assert 1e4 * found["remaining_ha"] == pytest.approx(48.0 * 6.0 - treated_m2, abs=8.0)
    mean_l_ha = 1e4 * found["remaining_l"] / (1e4 * found["remaining_ha"])
    assert 15.0 < mean_l_ha < 21.0
    features = json.loads(out.read_text())["features"]
    assert [each["properties"]["kind"] for each in features][-1] == "resume"
    assert features[-1]["geometry"]["coordinates"] == [
        found["resume"]["lon"], found["resume"]["lat"],
    ]  # fmt: skip
    areas = [shapely.geometry.shape(each["geometry"]) for each in features[:-1]]
    assert all(area.is_valid and 114.4 < area.centroid.x < 114.6 for area in areas)


def test_several_flights_are_one_job(
    first: Path, second: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = remaining(capsys, str(second), str(first))
    assert both["treated_ha"] > remaining(capsys, str(first))["treated_ha"]
    assert 1e4 * both["remaining_ha"] < 5.0


def test_a_file_that_is_no_journal_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["flights", "remaining", str(tmp_path / "absent.gpkg")]) == 2
    said = capsys.readouterr().err
    assert "no such file" in said
    assert "Traceback" not in said

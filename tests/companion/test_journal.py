"""The journal: what goes in comes out, whatever happens to the disk, the queue or the power."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import textwrap
import threading
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import cast, get_args

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely

from analysis.journals.content import read_journal
from companion.core.controller import Memory, step
from companion.core.inputs import AttitudeReport, ImuReport
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import (
    BatteryReport,
    ClockReport,
    Decision,
    DeclarationReport,
    EstimatorReport,
    EstopReport,
    Fix,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    LegReport,
    OperatorCommand,
    OutputReport,
    PressureReport,
    RangeReport,
    RateOverride,
    RcReport,
    SpeedReport,
    StandstillReport,
    TankReport,
    Telemetry,
    UtcReport,
    WindReport,
)
from companion.errors import JournalError
from companion.journal import writer as writer_module
from companion.journal.codec import decode, encode
from companion.journal.journal import Journal, open_for_flight
from companion.journal.rows import ValveOrder
from companion.journal.writer import Event, Writer
from tests.builders import flying, setup
from tests.companion.journal_edit import with_body

NAN, INF = math.nan, math.inf
ROOT = Path(__file__).resolve().parents[2]

INPUTS: list[Input] = [
    Telemetry(
        received_s=0.1 + 0.2,
        boot_s=5e-324,
        latitude_deg=NAN,
        longitude_deg=-INF,
        relative_altitude_m=-0.0,
        velocity_north_m_s=1 / 3,
        velocity_east_m_s=None,
        velocity_down_m_s=1.7976931348623157e308,
        heading_deg=None,
    ),
    SpeedReport(received_s=1.0, ground_speed_m_s=NAN),
    GnssReport(received_s=1.1, fix=Fix.RTK_FLOAT, horizontal_accuracy_m=0.014),
    EstimatorReport(received_s=1.2, healthy=True),
    HeartbeatReport(received_s=1.3, autopilot="px4", armed=True, mode='"AUTO"\n\udc80'),
    LandedReport(received_s=1.4, in_air=None),
    WindReport(received_s=INF, speed_m_s=2.5),
    RangeReport(received_s=1.55, height_m=None),
    RcReport(received_s=1.6, pulse_us=(1500, 0, 65535)),
    OperatorCommand(received_s=NAN, enable=True, source="web"),
    OutputReport(received_s=1.8, healthy=False, text="änderung"),
    EstopReport(received_s=1.85, pressed=True, source="line"),
    StandstillReport(received_s=1.86, gap_s=NAN),
    FlowReport(received_s=1.9, volume_ml=0.1 + 0.2),
    ClockReport(received_s=2.1, offset_s=-1 / 3, round_trip_s=NAN),
    LegReport(
        received_s=2.2,
        from_latitude_deg=36.1,
        from_longitude_deg=NAN,
        to_latitude_deg=-0.1,
        to_longitude_deg=1 / 3,
        stops=True,
        speed_m_s=None,
    ),
    RateOverride(received_s=2.0, percent=NAN),
    PressureReport(received_s=2.2, pressure_kpa=None, fault="1.2 mA: wire broken"),
    TankReport(received_s=2.3, level_l=1 / 3),
    UtcReport(received_s=2.35, utc_s=NAN),
    DeclarationReport(received_s=2.37, broken=("label-wind",), observed_s=(NAN, INF), said="{}"),
    BatteryReport(received_s=2.4, battery=1, consumed=4711.0, remaining_percent=None),
    AttitudeReport(
        received_s=0.5,
        boot_s=INF,
        roll_deg=-0.0,
        pitch_deg=NAN,
        yaw_deg=1 / 3,
        roll_rate_deg_s=5e-324,
        pitch_rate_deg_s=-INF,
        yaw_rate_deg_s=0.1 + 0.2,
    ),
    ImuReport(received_s=0.6, boot_s=-0.0, forward_m_s2=NAN, right_m_s2=1 / 3, down_m_s2=-9.81),
]


def decisions(how_many: int, given: Setup | None = None) -> list[Decision]:
    """Return the decisions of a flight over the plots, 20 a second at 5 m/s."""
    made, memory, over = [], Memory(), given or setup()
    for i in range(how_many):
        now_s = 10.0 + i / 20
        decision, memory = step(over, flying(now_s, east_m=1.0 + i / 4), memory, now_s)
        made.append(decision)
    return made


def texts(items: object) -> list[str]:
    """Return what tells values apart to the last bit, NaN being NaN."""
    return [encode(item) for item in items]  # type: ignore[attr-defined]


def query(path: Path, sql: str) -> list[tuple[object, ...]]:
    connection = sqlite3.connect(path)
    try:
        return connection.execute(sql).fetchall()
    finally:
        connection.close()


def change(path: Path, sql: str) -> None:
    connection = sqlite3.connect(path)
    try:
        with connection:
            connection.execute(sql)
    finally:
        connection.close()


def closed_journal(folder: Path, how_many: int = 30) -> Path:
    with Journal.create(folder, setup=setup(), started_s=10.0) as journal:
        for decision in decisions(how_many):
            journal.record_decision(decision)
    return journal.path


def writer_on(path: Path) -> tuple[Writer, sqlite3.Connection]:
    """Return a writer without its thread, on a file that `create` has made."""
    connection = open_for_flight(path)
    sequence = count(1).__next__
    writer = Writer(connection, frame=setup().frame, utc_offset_s=0.0, next_sequence=sequence)
    return writer, connection


# ------------------------------------------------------------------------- what goes in comes out


def test_every_kind_of_input_is_among_the_cases() -> None:
    assert {type(item) for item in INPUTS} == set(get_args(Input))


def test_inputs_and_decisions_come_back_in_their_order_to_the_last_bit(tmp_path: Path) -> None:
    given = [*INPUTS[:5], *decisions(3), *INPUTS[5:], *decisions(2)]
    with Journal.create(tmp_path, setup=setup()) as journal:
        for item in given:
            if isinstance(item, Decision):
                journal.record_decision(item)
            else:
                journal.record_input(item)
    assert texts(read_journal(journal.path).items()) == texts(given)


def test_a_value_read_back_is_of_the_type_that_was_recorded(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.record_input(INPUTS[2])
    assert list(read_journal(journal.path).items()) == [INPUTS[2]]


def test_a_field_that_an_older_version_did_not_have_takes_its_default() -> None:
    names = {"GnssReport": ["fix", "received_s"]}
    read = decode('{"GnssReport":[{"Fix":5},1.5]}', names)
    assert read == GnssReport(received_s=1.5, fix=Fix.RTK_FLOAT, horizontal_accuracy_m=None)


def test_events_come_back(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.record_event(12.5, "outputs", "board does not answer")
    (event,) = read_journal(journal.path).events
    assert event == Event(at_s=12.5, kind="outputs", text="board does not answer")


def test_the_set_up_comes_back_with_the_very_ground_that_was_flown(tmp_path: Path) -> None:
    ring = shapely.Point(20.1, 3.3).buffer(17 / 3)
    zones = [
        Zone(name="hole", polygon=shapely.difference(ring, ring.buffer(-1)), rate_l_ha=0.1 + 0.2),
        Zone(name="two", polygon=shapely.MultiPolygon([shapely.box(0, 0, 1, 1)]), rate_l_ha=0.0),
    ]
    flown = setup(
        prescription=Prescription(zones, overlap="last", default_rate_l_ha=7.1, sha256="ab12"),
        border="volume",
        lease_s=0.37,
    )
    with Journal.create(tmp_path, setup=flown) as journal:
        pass
    back = read_journal(journal.path).setup
    assert np.array_equal(back.prescription.edges.ends, flown.prescription.edges.ends)
    assert np.array_equal(back.prescription.edges.owner, flown.prescription.edges.owner)
    assert [(zone.name, zone.rate_l_ha) for zone in back.prescription.zones] == [
        ("hole", 0.1 + 0.2),
        ("two", 0.0),
    ]
    for name in ("overlap", "default_rate_l_ha", "sha256"):
        assert getattr(back.prescription, name) == getattr(flown.prescription, name)
    made = {"prescription", "guarded"}  # from the zones above
    for name in set(Setup.__dataclass_fields__) - made:
        assert getattr(back, name) == getattr(flown, name), name


def test_what_belongs_to_the_record_is_kept(tmp_path: Path) -> None:
    with Journal.create(
        tmp_path, setup=setup(), setup_text={"config_toml": "a = 'ü'\n"}
    ) as journal:
        pass
    meta = read_journal(journal.path).meta
    assert meta["config_toml"] == "a = 'ü'\n"
    assert meta["closed"] == "yes"
    assert {"version_vrspray", "version_numpy", "machine", "map_sha256", "setup"} <= set(meta)


# ------------------------------------------------------------------------------------ GeoPackage


def test_a_map_viewer_reads_what_was_applied(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 30)
    about = pyogrio.read_info(path, layer="applied")
    assert (about["geometry_type"], about["crs"], about["features"]) == ("Point", "EPSG:4326", 15)
    meta, _, geometry, columns = pyogrio.raw.read(path, layer="applied")
    rows = dict(zip(meta["fields"], columns, strict=True))
    places = [setup().frame.to_local(p.y, p.x) for p in shapely.from_wkb(geometry)]
    assert np.allclose(places, [(1.0 + i / 4, 3.0) for i in range(0, 30, 2)], atol=1e-6)
    assert np.allclose(rows["speed_m_s"], 5.0)
    assert np.allclose(rows["rate_l_ha"], 20.0)
    assert np.issubdtype(rows["time"].dtype, np.datetime64)
    assert np.allclose(np.diff(rows["time"]) / np.timedelta64(1, "ms"), 100, atol=1)


def test_a_map_viewer_reads_the_prescription_in_the_frame_of_the_flight(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 1)
    meta, _, geometry, columns = pyogrio.raw.read(path, layer="zones")
    to_file = pyproj.Transformer.from_crs(4326, pyproj.CRS(meta["crs"]), always_xy=True)
    assert to_file.transform(114.501, 36.001) == pytest.approx(
        setup().frame.to_local(36.001, 114.501), abs=1e-6
    )
    assert dict(zip(meta["fields"], columns, strict=True))["rate_l_ha"].tolist() == [20, 25, 15, 20]
    zones = [zone.polygon for zone in setup().prescription.zones]
    assert all(shapely.from_wkb(geometry) == np.array(zones))


def test_the_file_is_a_geopackage_before_the_first_row(tmp_path: Path) -> None:
    with Journal.create(tmp_path / "f", setup=setup()) as journal:
        alone = shutil.copy(journal.path, tmp_path / "copy.gpkg")
    assert {"applied", "zones", "field"} <= {name for name, _ in pyogrio.list_layers(alone)}
    header = Path(alone).read_bytes()
    assert header[68:72] == b"GPKG"
    assert int.from_bytes(header[60:64], "big") == 10400


def test_a_closed_journal_is_one_file_with_its_extent(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 20)
    assert [file.name for file in tmp_path.iterdir()] == ["flight-0001.gpkg"]
    box = query(path, "SELECT min_x, max_x FROM gpkg_contents WHERE table_name = 'applied'")
    west, east = cast("tuple[float, float]", box[0])
    assert west < east
    assert query(path, "PRAGMA journal_mode") == [("delete",)]
    assert query(path, "PRAGMA integrity_check") == [("ok",)]
    assert query(path, "PRAGMA foreign_key_check") == []


# --------------------------------------------------------------------------- folders and numbers


def test_flights_are_numbered_on(tmp_path: Path) -> None:
    (tmp_path / "flight-0041.gpkg").write_bytes(b"")
    with Journal.create(tmp_path, setup=setup()) as a, Journal.create(tmp_path, setup=setup()) as b:
        pass
    assert (a.path.name, b.path.name) == ("flight-0042.gpkg", "flight-0043.gpkg")


def test_a_folder_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "flights").write_text("not a folder")
    with pytest.raises(JournalError, match=r"flights: cannot be written") as refused:
        Journal.create(tmp_path / "flights", setup=setup())
    assert "\n" not in str(refused.value)


# ------------------------------------------------------------------- never waits and never raises


class Stuck:
    """An input that keeps the writer busy until it is let go, and cannot be written then."""

    def __init__(self) -> None:
        self.reached, self.let_go = threading.Event(), threading.Event()

    @property
    def received_s(self) -> float:
        self.reached.set()
        self.let_go.wait(20)
        return 1.0


def test_rows_that_find_the_queue_full_are_dropped_counted_and_reported(tmp_path: Path) -> None:
    stuck = Stuck()
    with Journal.create(tmp_path, setup=setup(), queue_rows=3) as journal:
        journal.record_input(cast(Input, stuck))
        assert stuck.reached.wait(20)
        for item in INPUTS[1:9]:
            journal.record_input(item)
        assert journal.lost == 5
        stuck.let_go.set()
    content = read_journal(journal.path)
    assert texts(content.items()) == texts(INPUTS[1:4])
    assert content.lost == 6  # five dropped, and the one that could not be written
    assert [event.kind for event in content.events] == ["rows-lost"]
    assert content.events[0].text.startswith("6 rows lost, 6 in all")
    assert content.meta["lost"] == "6"


def test_a_simulation_may_wait_for_the_disk_instead(tmp_path: Path) -> None:
    stuck = Stuck()
    with Journal.create(tmp_path, setup=setup(), queue_rows=2, waits=True) as journal:
        journal.record_input(cast(Input, stuck))
        assert stuck.reached.wait(20)
        threading.Timer(0.05, stuck.let_go.set).start()
        for item in INPUTS[1:9] * 5:
            journal.record_input(item)
    assert len(read_journal(journal.path).entries) == 40


def test_what_cannot_be_written_is_counted_and_the_record_goes_on(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        journal.record_input(INPUTS[3])
        journal.record_input(SpeedReport(received_s=1.0, ground_speed_m_s=cast(float, object())))
        journal.record_input(INPUTS[4])
    content = read_journal(journal.path)
    assert list(content.items()) == INPUTS[3:5]
    assert content.lost == 1


def test_after_the_end_nothing_is_taken_and_nothing_is_raised(tmp_path: Path) -> None:
    journal = Journal.create(tmp_path, setup=setup())
    journal.close()
    journal.record_input(INPUTS[0])
    journal.close()
    assert journal.lost == 1
    assert read_journal(journal.path).entries == ()


def full(path: Path) -> tuple[Writer, sqlite3.Connection]:
    """Return a writer whose database has room for three pages more."""
    writer, connection = writer_on(path)
    connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages + 3}").fetchall()
    return writer, connection


def test_a_full_disk_costs_nothing_once_there_is_room_again(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 0)
    writer, connection = full(path)
    writer.valves.from_orders = True
    made = decisions(400)
    faults = set()
    for sequence, decision in enumerate(made, 1):
        writer.write(sequence, decision)
        writer.write(0, ValveOrder(valve=0, duty=sequence / 1000, planned_s=None, given_s=1.0))
        if sequence % 5 == 0:
            writer.commit(lost_before=0)
            faults.add(writer.fault)
    assert "database or disk is full" in faults
    assert writer.waiting > 300 and writer.waiting + writer.committed == 400
    connection.execute("PRAGMA max_page_count = 1000000").fetchall()
    writer.commit(lost_before=0)
    assert (writer.fault, writer.waiting, writer.committed) == (None, 0, 400)
    writer.finish(lost_before=0)
    content = read_journal(path)
    assert texts(content.items()) == texts(made)
    assert content.lost == writer.lost == 0
    with closing(sqlite3.connect(path)) as reader:
        assert reader.execute("SELECT count(*) FROM valve_changes").fetchone() == (400,)


def test_memory_for_what_waits_has_an_end_and_what_follows_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "HELD_BYTES_MAX", 30_000)
    path = closed_journal(tmp_path, 0)
    writer, connection = full(path)
    made = decisions(400)
    for sequence, decision in enumerate(made, 1):
        if sequence == 300:
            connection.execute("PRAGMA max_page_count = 1000000").fetchall()
        writer.write(sequence, decision)
        if sequence % 5 == 0:
            writer.commit(lost_before=0)
            assert writer._waiting_bytes < 60_000
    writer.finish(lost_before=0)
    content = read_journal(path)
    assert 100 < content.lost == writer.lost == 400 - len(content.entries)
    assert content.entries[-1].body == encode(made[-1])
    assert any("disk is full" in event.text for event in content.events)


def test_a_flight_that_ends_on_a_full_disk_is_not_called_closed(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 0)
    writer, _ = full(path)
    for sequence, decision in enumerate(decisions(400), 1):
        writer.write(sequence, decision)
    writer.finish(lost_before=0)
    assert writer.lost == 400
    content = read_journal(path)
    assert not content.is_closed and content.entries == ()


def test_a_row_that_the_database_refuses_costs_itself_and_no_more(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 0)
    writer, _ = writer_on(path)
    writer.write(1, INPUTS[1])
    for sequence in (2, 2):
        writer.write(sequence, Event(at_s=1.0, kind="outputs", text="twice"))
    writer.write(3, INPUTS[3])
    writer.commit(lost_before=0)
    writer.finish(lost_before=0)
    assert (writer.lost, writer.committed) == (1, 3)
    assert texts(read_journal(path).items()) == texts([INPUTS[1], INPUTS[3]])


# A small disk of its own, which something else fills, and frees again while the flight goes on.
DISK = """
import json, sys, time
from pathlib import Path
from companion.journal.journal import Journal
from tests.builders import setup
from tests.companion.test_journal import decisions

disk, made, told = Path(sys.argv[1]), decisions(600), []
frees_at_end = sys.argv[2] == "end"
with Journal.create(disk, setup=setup(), commit_every_s=0.1) as journal:
    with (disk / "other").open("wb", buffering=0) as other:
        try:
            while True:
                other.write(bytes(4096))
        except OSError as error:
            told.append(error.errno)
    for number, decision in enumerate(made):
        journal.record_decision(decision)
        if number % 10 == 0:
            time.sleep(0.02)
    until_s = time.monotonic() + 60
    while journal.fault is None and time.monotonic() < until_s:
        time.sleep(0.01)
    time.sleep(0.6)
    told += [journal.fault, journal.lost, journal.saved_age_s > 0.5]
    if frees_at_end:
        import threading
        threading.Timer(0.5, (disk / "other").unlink).start()
    else:
        (disk / "other").unlink()
        while journal.committed < 600 and time.monotonic() < until_s:
            time.sleep(0.01)
        told += [journal.fault, journal.saved_age_s < 30.0]
from analysis.journals.content import read_journal
content = read_journal(journal.path)
print(json.dumps([*told, content.is_closed, content.lost, len(content.entries)]))
"""


@pytest.mark.parametrize("freed", ["in-flight", "end"])
def test_a_disk_that_was_full_for_a_while_has_the_whole_flight(tmp_path: Path, freed: str) -> None:
    own = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]
    script = 'mount -t tmpfs -o size=900k none "$1" && exec "$2" -c "$3" "$1" "$4"'
    given = [str(tmp_path), sys.executable, DISK, freed]
    try:
        done = subprocess.run(
            [*own, "sh", "-c", script, "sh", *given], cwd=ROOT, capture_output=True, timeout=50
        )
    except FileNotFoundError:
        pytest.skip("no unshare on this computer")
    if b"unshare" in done.stderr or b"mount:" in done.stderr:
        pytest.skip("no disk of its own for this user")
    told = json.loads(done.stdout)
    assert told[:4] == [28, "database or disk is full", 0, True]
    assert told[4:] == [*([None, True] if freed == "in-flight" else []), True, 0, 600]


# ------------------------------------------------------------------------- cut off, broken, alien


def test_every_committed_row_survives_the_death_of_the_process(tmp_path: Path) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "committed\n"
    child.send_signal(signal.SIGKILL)
    child.communicate()
    content = read_journal(tmp_path / "flight-0001.gpkg")
    assert not content.is_closed
    assert texts(content.items()) == texts(decisions(10))


CHILD = textwrap.dedent(
    """
    import pathlib, sys, time
    from companion.journal.journal import Journal
    from tests.builders import setup
    from tests.companion.test_journal import decisions

    made = decisions(10)
    journal = Journal.create(pathlib.Path(sys.argv[1]), setup=setup())
    for decision in made:
        journal.record_decision(decision)
    while journal.committed < 10:
        time.sleep(0.01)
    print("committed", flush=True)
    sys.stdin.read()
    """
)


def test_reading_what_a_crash_left_does_not_change_it(tmp_path: Path) -> None:
    path = closed_journal(tmp_path / "a", 0)
    writer, connection = writer_on(path)
    for sequence, decision in enumerate(decisions(5), 1):
        writer.write(sequence, decision)
    writer.commit(lost_before=0)
    left = tmp_path / "left"
    shutil.copytree(path.parent, left)
    connection.close()
    before = {file.name: file.read_bytes() for file in left.glob("*.gpkg*")}
    assert any(name.endswith("-wal") for name in before)
    assert len(read_journal(left / path.name).entries) == 5
    assert {name: (left / name).read_bytes() for name in before} == before


def test_a_journal_that_is_still_written_is_not_read(tmp_path: Path) -> None:
    with (
        Journal.create(tmp_path, setup=setup()) as journal,
        pytest.raises(JournalError, match="its flight still writes it"),
    ):
        read_journal(journal.path)


def test_a_journal_that_is_still_written_is_locked_for_other_processes(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        with pytest.raises(JournalError):
            read_journal(journal.path)  # must not give the locks up
        code = (
            "import contextlib, sqlite3\n"
            f"with contextlib.closing(sqlite3.connect({str(journal.path)!r}, timeout=0)) as db:\n"
            "    db.execute('VACUUM')\n"
        )
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "database is locked" in other.stderr


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def garble(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[4096:] = bytes(255 - byte for byte in content[4096:])
    path.write_bytes(content)


BROKEN = {
    "missing": (Path.unlink, "there is no such file"),
    "empty": (lambda path: os.truncate(path, 0), "this is not a journal"),
    "text": (lambda path: path.write_text("x" * 200), "this is not a journal"),
    "cut": (cut, "is damaged"),
    "garbled": (garble, "is damaged"),
    "version": (
        lambda path: change(path, "UPDATE meta SET value = '9' WHERE key = 'journal_version'"),
        "journal of version 9, this program reads versions 1 and 2",
    ),
    "other database": (
        lambda path: change(path, "PRAGMA application_id = 5"),
        "this is not a journal",
    ),
    "no blocks": (lambda path: change(path, "DROP TABLE blocks"), "the table blocks is missing"),
    "set-up": (
        lambda path: change(path, "UPDATE meta SET value = '{}' WHERE key = 'setup'"),
        "is damaged",
    ),
    "polygon": (lambda path: change(path, "UPDATE zones SET geom = x'00'"), "is damaged"),
    "row": (
        lambda path: with_body(path, 3, '{"Setup":[]}'),
        "row 3: no Setup of this version",
    ),
    "type": (
        lambda path: with_body(path, 3, '{"SpeedReport":1}'),
        "row 3: ",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_cannot_be_used_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    path = closed_journal(tmp_path)
    breakage, text = BROKEN[case]
    breakage(path)  # type: ignore[operator]
    with pytest.raises(JournalError, match=text) as refused:
        list(read_journal(path).items())
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)

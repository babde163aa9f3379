"""Flights along logs: of a made-up flight, and of real ones in the folder VRSPRAY_REAL."""

from __future__ import annotations

import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from typer.testing import CliRunner

import sitl.along
from companion.cli.app import app
from companion.core.prescription import Prescription
from companion.errors import ConfigError
from sitl.along import (
    METHODS,
    AlongOptions,
    Bed,
    along_lines,
    figures_of,
    fly_along,
    fly_method,
    prepare,
)
from sitl.anyang import EXAMPLE
from sitl.earth import Earth
from sitl.fly_files import _draw_share
from sitl.follow import Told, along
from sitl.recorded import paths_of, read_flight, receiver_of
from sitl.serve import Following, Step
from sitl.stub.protocol import dialect
from tests import flown_logs
from tests.sitl.stub_bench import Bench

LOGS = Path(os.environ.get("VRSPRAY_REAL", "")) / "flights"
needs_logs = pytest.mark.skipif(
    "VRSPRAY_REAL" not in os.environ, reason="no logs of real flights: set VRSPRAY_REAL"
)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown_logs.telemetry(tmp_path_factory.mktemp("log") / "made-up.tlog")


# ------------------------------------------------------------------------------------------ reading

# What every dataflash log begins with: the format of formats, then that of its places.
DATAFLASH = b"".join(
    b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, name, form, columns)
    for number, length, name, form, columns in (
        (128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"),
        (129, 23, b"POS", b"QLLf", b"TimeUS,Lat,Lng,RelHomeAlt"),
    )
)


@pytest.mark.parametrize("form", ["tlog", "ulg"])
def test_every_kind_of_log_tells_the_same_flight(form: str, tmp_path: Path) -> None:
    if form == "ulg":
        pytest.importorskip("pyulog")
    write = flown_logs.telemetry if form == "tlog" else flown_logs.ulog
    flight = read_flight(write(tmp_path / f"a.{form}"))
    rows = flown_logs.told()
    rows = rows[np.isin(np.round(rows[:, 0], 3), np.round(flight.states.time_s, 3))]
    assert len(rows) == len(flight.states) > 200
    assert flight.states.latitude_deg == pytest.approx(rows[:, 1], abs=2e-7)
    assert flight.states.longitude_deg == pytest.approx(rows[:, 2], abs=2e-7)
    assert flight.states.north_m_s == pytest.approx(rows[:, 3], abs=0.006)
    assert flight.states.east_m_s == pytest.approx(rows[:, 4], abs=0.006)
    turned = (flight.states.heading_deg - rows[:, 5] + 180.0) % 360.0 - 180.0
    assert np.abs(turned).max() < 0.02
    assert {mode for _, mode in flight.modes} == {"AUTO" if form == "tlog" else "MISSION"}
    assert all(armed for _, armed in flight.armed)
    assert {fix for _, fix in flight.fixes} == {6}
    assert flight.receiver.shape[0] == 3


def test_a_log_that_pauses_is_two_flights_and_the_longer_one_is_flown(tmp_path: Path) -> None:
    path = flown_logs.telemetry(tmp_path / "a.tlog", skip_s=(106.0, 109.0))
    flight = read_flight(path)
    assert flight.states.time_s[0] >= 109.0
    assert flight.notes == ("the log holds 2 flights; the longest one is used",)
    short = read_flight(flown_logs.telemetry(tmp_path / "b.tlog", skip_s=(108.0, 108.5)))
    assert short.notes == ("1 gap between positions, up to 0.60 s, kept as recorded",)


def test_an_autopilot_that_begins_anew_has_flown_twice(log: Path, tmp_path: Path) -> None:
    twice = tmp_path / "twice.tlog"
    twice.write_bytes(log.read_bytes() * 2)
    flight = read_flight(twice)
    assert flight.states.time_s == pytest.approx(read_flight(log).states.time_s, abs=1e-6)
    assert any("2 flights" in note for note in flight.notes)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.tlog", b"", "empty"),
        ("a.tlog", b"\0" * 5000, "not a .tlog log"),
        ("a.tlog", b"\0" * 8 + b"\xfe\x01" + b"\0" * 5000, "no flight"),
        ("a.bin", b"", "empty"),
        ("a.BIN", b"Renamed.\n" * 5000, "not a .BIN log"),
        ("a.bin", b"\xa3\x95\x80" + b"x" * 5000, "damaged"),
        ("a.bin", DATAFLASH + b"x" * 5000, "damaged"),
        ("a.bin", DATAFLASH.replace(b"QLLf", b"Q\\Lf"), "damaged"),
        ("a.csv", b"1,2", "give one of .bin, .tlog, .ulg"),
        ("a.ulg", b"", "empty"),
        ("a.ulg", b"Renamed.", "not a .ulg log"),
        ("a.ulg", b"ULog", "damaged"),
        ("missing.tlog", None, "no such file"),
        ("missing.BIN", None, "no such file"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(
    name: str,
    content: bytes | None,
    why: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    if why == "damaged" and name.endswith("ulg"):
        pytest.importorskip("pyulog")
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError) as refused:
        read_flight(path)
    assert why in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    # No word of Python's, and nothing of the reader's own.
    assert "Error" not in str(refused.value)
    assert capfd.readouterr() == ("", "")


def test_without_pyulog_a_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ConfigError, match=r"pyulog is not installed; .*vrspray\[office\]"):
        read_flight(flown_logs.ulog(tmp_path / "a.ulg"))


# ----------------------------------------------------------------------------------------- the path


def test_the_smoothed_path_is_nearer_to_the_truth_than_what_was_told(log: Path) -> None:
    bed = prepare(AlongOptions(log=log, position_rate_hz=10.0))
    truth = flown_logs.flown().at(bed.path.time_s)
    east_m, north_m = Earth(*_origin(bed)).to_local_all(
        *flown_logs.HOME.to_geographic_all(truth.east_m, truth.north_m)
    )
    off_m = np.hypot(bed.path.east_m - east_m, bed.path.north_m - north_m)
    assert float(np.sqrt((off_m**2).mean())) < 0.015  # told: 0.028
    turned = (bed.path.heading_deg - truth.heading_deg + 180.0) % 360.0 - 180.0
    assert np.abs(turned).mean() < 0.2


def _origin(bed: Bed) -> tuple[float, float]:
    return bed.setup.frame.latitude_deg, bed.setup.frame.longitude_deg


def test_rates_leave_states_out_or_put_some_between_and_none_into_a_gap(
    log: Path, tmp_path: Path
) -> None:
    every = read_flight(log).states
    half = prepare(AlongOptions(log=log, position_rate_hz=5.0))
    assert np.isin(half.told.time_s, every.time_s).all()
    assert len(half.told) == pytest.approx(len(every) / 2, abs=1)
    assert not any("interpolated" in note for note in half.notes)
    path = flown_logs.telemetry(tmp_path / "gap.tlog", skip_s=(108.0, 108.6))
    double = prepare(AlongOptions(log=path, position_rate_hz=20.0))
    steps_s = np.diff(double.told.time_s)
    assert float(np.median(steps_s)) == pytest.approx(0.05, abs=0.001)
    assert (steps_s > 0.51).sum() == 1
    assert any("interpolated" in note for note in double.notes)


def test_how_late_and_how_far_off_a_receiver_is_against_the_estimate(log: Path) -> None:
    flight = read_flight(log)
    path, _ = paths_of(flight, flown_logs.HOME)
    at_s = np.arange(path.time_s[0], path.time_s[-1], 0.2)
    late = path.at(at_s - 0.08)
    place = flown_logs.HOME.to_geographic_all(late.east_m + 0.3, late.north_m - 0.4)
    found = receiver_of(replace(flight, receiver=np.array([at_s, *place])))
    assert found is not None
    assert found.late_s == pytest.approx(0.08, abs=0.005)
    assert found.off_m == pytest.approx(0.5, abs=0.02)
    # Telemetry stamps a fix by the autopilot's clock; a time of day is no such stamp.
    found = receiver_of(flight)
    assert found is not None
    assert found.late_s == pytest.approx(flown_logs.BEHIND_S, abs=0.01)
    assert found.off_m < 0.05


@needs_logs
def test_what_a_ground_station_heard_tells_it_too() -> None:
    """Positions at 1 Hz and a receiver of 2018, for which ArduPilot assumes more."""
    found = receiver_of(read_flight(LOGS / "phoenix-mission1.tlog"))
    assert found is not None
    assert found.late_s == pytest.approx(0.2, abs=0.06)
    assert found.off_m < 0.5


@needs_logs
@pytest.mark.parametrize(("name", "late_ms"), [("q116", 91), ("q130", 59), ("q083", 103)])
def test_receivers_of_real_flights_are_behind_their_estimates(name: str, late_ms: int) -> None:
    notes = " ".join(prepare(AlongOptions(log=LOGS / f"{name}.BIN")).notes)
    assert f"measured one): {late_ms} ms" in notes
    assert "UNUSUAL" not in notes


# ------------------------------------------------------------------------------------- closed loop


def test_a_flight_is_judged_beside_its_references(log: Path, tmp_path: Path) -> None:
    options = AlongOptions(log=log, position_rate_hz=10.0, flights=1, out=tmp_path / "out")
    said: list[str] = []
    result = fly_along(options, said.append)
    rows = {row["method"]: row for row in result["methods"]}
    assert tuple(rows) == METHODS
    wrong = {name: row["misapplied_percent"]["mean"] for name, row in rows.items()}
    assert wrong["perfect"] < wrong["vrspray"] < wrong["none"]
    assert wrong["perfect"] < 5.0
    # All are judged by the same changes, which are such as can be had.
    assert len({row["changes"] for row in rows.values()}) == 1
    assert rows["perfect"]["changes"] > 20
    assert rows["perfect"]["missed"] <= 0.02 * rows["perfect"]["changes"]
    assert rows["perfect"]["lag_distance_m"]["median_abs"] < 0.06
    assert rows["perfect"]["switch_m"]["median_abs"] < 0.05
    assert rows["none"]["switch_m"]["mean"] > 0.3
    assert (tmp_path / "out" / "result.json").exists()
    pytest.importorskip("matplotlib")
    assert (tmp_path / "out" / "along.png").stat().st_size > 20_000
    lines = list(along_lines(result))
    assert lines[5].startswith("look-ahead")
    assert any(line.startswith("limits: ") for line in lines)


def test_what_falls_outside_is_counted_and_drawn(log: Path) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    bed = prepare(AlongOptions(log=log, position_rate_hz=10.0))
    south = shapely.box(-500.0, -500.0, 500.0, 25.0)
    zones = [
        replace(zone, polygon=zone.polygon.intersection(south))
        for zone in bed.setup.prescription.zones
        if zone.polygon.intersects(south)
    ]
    bed = replace(bed, setup=replace(bed.setup, prescription=Prescription(zones)))
    outside_ml, cells = {}, {}
    for method in ("vrspray", "none"):
        result = fly_method(bed, method, 1)
        outside_ml[method] = figures_of(bed, result)["outside_ml"]
        axes = Figure().subplots()
        cells[method] = np.ma.compressed(_draw_share(result.record, axes).get_array())
    assert outside_ml["vrspray"] < 0.5 < 5.0 < outside_ml["none"]
    # Ground on which nothing was prescribed is off the scale; the rest got what it should.
    assert (cells["none"] > 200.0).sum() > 10 > (cells["vrspray"] > 200.0).sum()
    assert np.median(cells["vrspray"]) == pytest.approx(100.0, abs=5.0)


@needs_logs
def test_ground_flown_over_twice_is_not_drawn_as_too_wet() -> None:
    """Passes that cross each other: the zones are prescribed to each of them."""
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    bed = prepare(AlongOptions(log=LOGS / "q130.BIN", position_rate_hz=10.0))
    image = _draw_share(fly_method(bed, "vrspray", 1).record, Figure().subplots())
    cells = np.ma.compressed(image.get_array())
    assert np.median(cells) == pytest.approx(100.0, abs=5.0)
    assert np.quantile(cells, 0.95) < 130.0


def test_a_flight_by_hand_is_sprayed_and_said_to_be_barred(tmp_path: Path) -> None:
    path = flown_logs.telemetry(tmp_path / "hand.tlog", mode=flown_logs.LOITER)
    bed = piece(prepare(AlongOptions(log=path, position_rate_hz=10.0)), 100.0, 109.0)
    assert bed.notes[-1] == "[safety] would have kept the valves closed (LOITER); ignored here"
    assert fly_method(bed, "vrspray", 1).record.volume_ml[-1].sum() > 100.0


def test_the_hidden_sprayer_has_the_period_and_the_lags_that_are_configured(log: Path) -> None:
    bed = prepare(AlongOptions(log=log))
    assert bed.profile.pwm.period_s == bed.setup.pwm.period_s
    assert bed.profile.mean_lag_s == pytest.approx(
        0.5 * (bed.setup.lag.on_s + bed.setup.lag.off_s), abs=0.001
    )
    assert bed.profile.lag_scatter > 0.0


@pytest.mark.parametrize("rate_hz", [0.0, 3.0, 100.0, float("nan")])
def test_rates_by_which_nobody_sprays_are_refused(log: Path, rate_hz: float) -> None:
    with pytest.raises(ConfigError, match="--position-rate-hz"):
        prepare(AlongOptions(log=log, position_rate_hz=rate_hz))


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (("--mission", "a.plan"), "leave the others out"),
        (("--seed", "-1"), "--seed"),
        (("--flights", "0"), "--flights"),
        (("--config", str(EXAMPLE.parent / "pump" / "config.toml")), "needs PWM valves"),
        (("--config", str(EXAMPLE.parent / "pump-sections" / "config.toml")), "needs PWM valves"),
        (("--plant", "pump"), "as many PWM valves"),
        (("--out", "/proc/nowhere"), "--out /proc/nowhere: cannot be written"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    more: tuple[str, str], why: str, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl.along, "METHODS", ("vrspray", "perfect"))
    words = ["sitl", "fly", "--along", str(log), "--flights", "1", *more]
    answer = CliRunner().invoke(app, words)
    assert isinstance(answer.exception, ConfigError)
    assert why in str(answer.exception)
    assert "\n" not in str(answer.exception)


# ------------------------------------------------------------------------------------- on the wire


def test_the_stub_follows_a_flight_with_its_states_and_modes(log: Path) -> None:
    flight = read_flight(log)
    home = Earth(*(float(flight.states[name][0]) for name in ("latitude_deg", "longitude_deg")))
    motions = along(flight, home)
    bench = Bench(home=home, believed=Told(motions[1]))
    operator = Following(bench.autopilot, motions, start_s=bench.now_s)
    bench.companion.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    position = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
    for message in (position, dialect.MAVLINK_MSG_ID_GPS_RAW_INT):
        bench.companion.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message, 100_000.0)
    while operator.step is not Step.DONE:
        assert bench.now_s < 1100.0
        bench.run(0.02)
        operator.tick(bench.now_s)
    start_s = motions[0].start_s
    states, length_s = flight.states, float(np.ptp(flight.states.time_s))
    told = [
        m for m in bench.companion.of("GLOBAL_POSITION_INT") if 0.2 < m.at_s - start_s < length_s
    ]
    assert len(told) > 200
    at_s = np.array([m.at_s for m in told]) - start_s + states.time_s[0]
    for name, values in (
        ("latitude_deg", [m.lat * 1e-7 for m in told]),
        ("longitude_deg", [m.lon * 1e-7 for m in told]),
    ):
        wanted = np.interp(at_s, states.time_s, states[name])
        assert np.abs(np.array(values) - wanted).max() < 3e-7
    # The receiver's places come at their own stamps.
    rows = {round(row[0], 3): row[1:] for row in flight.receiver.T.tolist()}
    fixes = [m for m in bench.companion.of("GPS_RAW_INT") if 0.3 < m.at_s - start_s < length_s]
    assert len(fixes) > 10
    boot_s = np.median([m.at_s - m.time_boot_ms / 1e3 for m in told])
    for m in fixes:
        log_s = m.time_usec / 1e6 + boot_s - start_s + states.time_s[0]
        nearest = min(rows, key=lambda each: abs(each - log_s))
        assert nearest == pytest.approx(log_s, abs=0.003)
        assert (m.lat * 1e-7, m.lon * 1e-7) == pytest.approx(rows[nearest], abs=2e-7)
    beats = [m for m in bench.companion.of("HEARTBEAT") if 1.1 < m.at_s - start_s < length_s - 0.1]
    assert {m.custom_mode for m in beats} == {flown_logs.AUTO}
    assert all(m.base_mode & 128 for m in beats)


# ------------------------------------------------------------------------------------- real flights


@needs_logs
def test_the_smoothed_path_stays_by_what_was_told() -> None:
    bed = prepare(AlongOptions(log=LOGS / "q130.BIN"))
    assert any("differ by 0.02 m" in note for note in bed.notes)
    path, states = bed.path.at(bed.flight.states.time_s), bed.flight.states
    off_m_s = np.hypot(
        path.velocity_east_m_s - states.east_m_s, path.velocity_north_m_s - states.north_m_s
    )
    assert float(np.sqrt((off_m_s**2).mean())) < 0.06


@needs_logs
def test_a_piece_of_a_real_flight_is_sprayed_better_the_more_is_known() -> None:
    bed = prepare(AlongOptions(log=LOGS / "q130.BIN", position_rate_hz=10.0))
    bed = piece(bed, 6808.0, 6818.0)
    found = [figures_of(bed, fly_method(bed, m, 1)) for m in ("perfect", "vrspray", "none")]
    perfect, ours, none = (each["misapplied_percent"] for each in found)
    assert perfect < ours < none
    assert perfect < 6.0


@needs_logs
def test_logs_of_all_kinds_that_were_really_written_are_read() -> None:
    moved_m = {}
    for path in sorted(LOGS.iterdir()):
        flight = read_flight(path, lambda mode: mode == "AUTO")
        way = np.trapezoid(flight.speed_m_s, flight.states.time_s)
        moved_m[path.name] = round(float(way))
    assert moved_m["q116.BIN"] == pytest.approx(48, abs=3)
    assert moved_m["q130.BIN"] == pytest.approx(140, abs=5)
    assert moved_m["q083.BIN"] == pytest.approx(295, abs=10)
    assert moved_m["phoenix-mission1.tlog"] > 80


def piece(bed: Bed, begin_s: float, end_s: float) -> Bed:
    """A few seconds of a flight."""
    within = [
        (each >= begin_s) & (each <= end_s)
        for each in (bed.path.time_s, bed.flight.states.time_s, bed.told.time_s)
    ]
    return replace(
        bed,
        path=bed.path.at(bed.path.time_s[within[0]]),
        flight=replace(bed.flight, states=bed.flight.states[within[1]]),
        told=bed.told[within[2]],
    )

"""ISOXML: the task by the `isoxml` package, the log byte by byte as ISO 11783-10 has it."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import struct
import subprocess
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from isoxml.models.ddi_entities import DDEntity
from isoxml.util.isoxml_io import isoxml_from_path

from analysis.exports.cli import format_for
from analysis.exports.isoxml_task import logged, records
from analysis.exports.output import write_beside, write_folder
from analysis.exports.source import Source
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.read_applied import read_applied
from tests.analysis.export_flight import fly
from tests.builders import boom, setup

NODE_MODULES = "VRSPRAY_NODE_MODULES"


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    facts = {
        "application_json": json.dumps({"application.operator": "Wang X.", "product.name": "P 25"})
    }
    return read_applied(fly(tmp_path_factory.mktemp("flown"), training="no", facts=facts))


@pytest.fixture(scope="module")
def given(flight: AppliedFlight) -> Source:
    return Source(flight=flight, shape="points")


@pytest.fixture(scope="module")
def folder(given: Source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "TASKDATA"
    write_folder(out, format_for(out, None).maker()(given, out), force=False)
    return out


@dataclasses.dataclass(frozen=True)
class Record:
    time: datetime
    gps: datetime
    north_deg: float
    east_deg: float
    status: int
    values: dict[tuple[int, str], int]


def moment(ms: int, days: int) -> datetime:
    return datetime(1980, 1, 1, tzinfo=UTC) + timedelta(days=days, milliseconds=ms)


def decoded(folder: Path) -> Iterator[Record]:
    """Yield the records, read by the template as the standard says."""
    template = ElementTree.parse(folder / "TLG00001.xml").getroot()
    place = template.find("PTN")
    assert place is not None
    assert {name for name, value in place.attrib.items() if value == ""} == set("ABDHI")
    kinds = [(int(each.attrib["A"], 16), each.attrib["C"]) for each in template.findall("DLV")]
    content = memoryview((folder / "TLG00001.bin").read_bytes())
    at = 0
    while at < len(content):
        ms, days, north, east, status, gps_ms, gps_days, count = struct.unpack_from(
            "<IHiiBIHB", content, at
        )
        at += struct.calcsize("<IHiiBIHB")
        values = {}
        for _ in range(count):
            index, value = struct.unpack_from("<Bi", content, at)
            at += 5
            values[kinds[index]] = value
        yield Record(
            moment(ms, days), moment(gps_ms, gps_days), north / 1e7, east / 1e7, status, values
        )
    assert at == len(content)


def test_the_log_holds_the_flight(given: Source, folder: Path) -> None:
    samples, found = given.samples, list(decoded(folder))
    assert len(found) == len(samples)
    assert all(record.time == record.gps for record in found)
    times = np.array([record.time.timestamp() for record in found])
    assert np.abs(times - samples.utc_s).max() <= 1e-3
    places = np.array([(record.north_deg, record.east_deg) for record in found])
    assert np.abs(places[:, 0] - samples.latitude_deg).max() <= 1e-7
    assert np.abs(places[:, 1] - samples.longitude_deg).max() <= 1e-7

    def values(ddi: int, element: str = "DET-2") -> np.ndarray:
        return np.array([record.values[ddi, element] for record in found])

    # 0.01 mm3/m2 a step: 10 000 are 1 L/ha. mm3/s, mm, mm/s, 0.1 Pa.
    np.testing.assert_allclose(values(1), 1e4 * np.nan_to_num(samples.rate_l_ha), atol=1)
    np.testing.assert_allclose(values(2), 1e4 * samples.applied_l_ha, atol=1)
    np.testing.assert_allclose(values(37), 1e6 / 60 * samples.flow_l_min, atol=1)
    np.testing.assert_allclose(values(67), 1000 * samples.width_m, atol=1)
    np.testing.assert_allclose(values(397), 1000 * samples.speed_m_s, atol=1)
    assert samples.pressure_kpa is not None
    np.testing.assert_allclose(values(194), 1e4 * samples.pressure_kpa, atol=1)
    assert (values(141) == (samples.flow_l_min > 0)).all()
    for valve in range(6):
        is_open = samples.valve_flow_l_min[:, valve] > 0
        assert (((values(161) >> 2 * valve) & 3) == is_open).all()
        raw = values(2, f"DET-{3 + valve}")
        np.testing.assert_allclose(raw, 1e4 * samples.valve_applied_l_ha[:, valve], atol=1)
    # Flow over time is the volume, from the log alone.
    litres = float(np.trapezoid(values(37), times)) / 1e6
    assert litres == pytest.approx(given.volume_l, rel=1e-3)


# What each identifier is logged as, by the package's copy of the data dictionary: unit and step.
USED = {
    1: ("mm³/m²", 0.01),
    2: ("mm³/m²", 0.01),
    37: ("mm³/s", 1),
    67: ("mm", 1),
    70: ("mm", 1),
    80: ("L", 1),
    116: ("m²", 1),
    117: ("mm", 1),
    119: ("s", 1),
    134: ("mm", 1),
    135: ("mm", 1),
    136: ("mm", 1),
    141: ("n.a.", 1),
    161: ("n.a.", 1),
    194: ("Pa", 0.1),
    351: ("ml", 1),
    397: ("mm/s", 1),
}


def test_the_identifiers_are_those_of_the_data_dictionary(folder: Path) -> None:
    used = {
        int(each.attrib[key], 16)
        for tag, key in (("DPD", "B"), ("DPT", "B"), ("DLV", "A"))
        for each in ElementTree.parse(folder / "TASKDATA.XML").getroot().iter(tag)
    }
    assert used == set(USED)
    for ddi, (unit, step) in USED.items():
        entity = DDEntity.from_id(ddi)
        assert (entity.unit, entity.bit_resolution) == (unit, step), entity


def faults(element: Any, path: str = "") -> Iterator[str]:
    """Yield what of an element the package's model of the standard does not allow."""
    for field in dataclasses.fields(element):
        value = getattr(element, field.name)
        where = f"{path}/{type(element).__name__}.{field.name}"
        if isinstance(value, list):
            for each in value:
                if dataclasses.is_dataclass(each):
                    yield from faults(each, where)
        elif value is None:
            if field.metadata.get("required"):
                yield f"{where} is missing"
        else:
            yield from faults_of_value(value, field.metadata, where)


def faults_of_value(value: Any, rules: Mapping[str, Any], where: str) -> Iterator[str]:
    text = value.hex() if isinstance(value, bytes) else str(getattr(value, "value", value))
    if isinstance(value, str | bytes):
        # Labels are bytes that the package leaves as text, two digits a byte.
        size = len(bytes.fromhex(value)) if where.endswith("_label") else len(value)
        least = rules.get("length", rules.get("min_length", 0))
        if not least <= size <= rules.get("length", rules.get("max_length", size)):
            yield f"{where} has the length {size}"
    if "pattern" in rules and not re.fullmatch(rules["pattern"], text):
        yield f"{where} is {text}"
    for rule, sign in (("min_inclusive", 1), ("max_inclusive", -1)):
        if rule in rules and sign * (value - rules[rule]) < 0:
            yield f"{where} is {value}, {rule} {rules[rule]}"


def test_the_package_reads_the_task_and_finds_no_fault(given: Source, folder: Path) -> None:
    data, files = isoxml_from_path(folder)
    assert list(faults(data)) == []
    assert set(files) == {"TLG00001"}
    (task,) = data.tasks
    assert task.designator == "flight-0001"
    assert task.status.value == "4"
    (time,) = task.times
    assert time.start.to_datetime().timestamp() == pytest.approx(given.samples.utc_s[0], abs=1e-3)
    assert time.stop.to_datetime().timestamp() == pytest.approx(given.samples.utc_s[-1], abs=1e-3)
    totals = {
        int.from_bytes(each.process_data_ddi): each.process_data_value
        for each in time.data_log_values
    }
    assert totals[351] == pytest.approx(1000.0 * given.volume_l, abs=0.5)
    assert totals[80] == round(given.volume_l)
    # Twice 48 m, once with half of the boom, less the border's buffer.
    assert totals[116] == pytest.approx(48.0 * 9.0, rel=0.02)
    assert totals[117] == pytest.approx(96_000.0, rel=0.02)
    assert totals[119] == pytest.approx(96.0 / 5.0, abs=1.0)
    (field,) = data.partfields
    assert field.area == 384
    (log,) = task.time_logs
    assert log.filelength == (folder / "TLG00001.bin").stat().st_size
    assert [product.designator for product in data.products] == ["P 25"]
    assert [worker.last_name for worker in data.workers] == ["Wang X."]
    comments = [each.free_comment_text for each in task.comment_allocations]
    assert "training: no" in comments
    assert f"map: {given.about.map_sha256[:20]}" in comments


def test_sections_sit_where_the_boom_has_them(folder: Path) -> None:
    device = isoxml_from_path(folder)[0].devices[0]
    values = {each.object_id: (int.from_bytes(each.ddi), each.value) for each in device.properties}
    told = {each.object_id for each in device.process_data} | set(values)
    numbers = [each.object_id for each in device.elements] + [*told]
    assert len(numbers) == len(set(numbers))
    sections = [each for each in device.elements if each.type.value == "4"]
    placed = [
        dict(
            values[each.device_object_id]
            for each in one.device_object_references
            if each.device_object_id in values
        )
        for one in sections
    ]
    assert [each[135] for each in placed] == [-2500, -1500, -500, 500, 1500, 2500]
    assert {each[67] for each in placed} == {1000}
    referred = {
        each.device_object_id for one in device.elements for each in one.device_object_references
    }
    assert referred == told


def test_a_zip_holds_the_folder_that_terminals_look_for(given: Source, tmp_path: Path) -> None:
    out = tmp_path / "task.zip"
    write_beside(out, format_for(out, "isoxml").maker()(given, out), force=False)
    shutil.unpack_archive(out, tmp_path / "all")
    data, _ = isoxml_from_path(tmp_path / "all" / "TASKDATA")
    assert data.tasks[0].designator == "flight-0001"


def test_a_training_is_no_product(flight: AppliedFlight, tmp_path: Path) -> None:
    dry = dataclasses.replace(flight, meta={**flight.meta, "training": "dry"})
    out = tmp_path / "TASKDATA"
    content = format_for(out, None).maker()(Source(flight=dry, shape="points"), out)
    write_folder(out, content, force=False)
    data, _ = isoxml_from_path(out)
    assert [product.designator for product in data.products] == ["training: dry"]
    assert data.tasks[0].designator == "flight-0001 (training: dry)"


def test_a_boom_of_many_valves_keeps_its_states(tmp_path: Path) -> None:
    many = 40
    nozzles = dataclasses.replace(setup().nozzle_sets[0], valves=tuple(range(many)))
    used = setup(boom=boom(many), nozzle_sets=(nozzles,))
    given = Source(flight=read_applied(fly(tmp_path, given=used)), shape="points")
    values = logged(given.samples)
    states = [each.raw for each in values if 161 <= each.ddi <= 176]
    assert [each.ddi for each in values if 161 <= each.ddi <= 176] == [161, 162, 163]
    is_open = given.samples.valve_flow_l_min > 0.0
    for valve in range(many):
        bits = states[valve // 16] >> 2 * (valve % 16) & 3
        assert (bits == is_open[:, valve]).all()
    assert len(records(given.samples, values)) == len(given.samples) * (22 + 5 * len(values))


@pytest.mark.skipif(
    not os.environ.get(NODE_MODULES) or shutil.which("node") is None,
    reason=f"{NODE_MODULES} names no folder with the package isoxml of npm",
)
def test_the_package_of_npm_reads_the_same(given: Source, tmp_path: Path) -> None:
    out = tmp_path / "task.zip"
    write_beside(out, format_for(out, "isoxml").maker()(given, out), force=False)
    script = """
        const {ISOXMLManager} = require('isoxml'), fs = require('fs');
        (async () => {
            const manager = new ISOXMLManager({version: 4});
            await manager.parseISOXMLFile(new Uint8Array(fs.readFileSync(process.argv[1])),
                'application/zip');
            const log = manager.getEntitiesOfTag('TSK')[0].attributes.TimeLog[0];
            const parsed = log.parseBinaryFile();
            console.log(JSON.stringify({warnings: manager.getWarnings(), errors: log.parsingErrors,
                info: parsed.valuesInfo, records: parsed.timeLogs}));
        })();
    """
    environment = {**os.environ, "NODE_PATH": os.environ[NODE_MODULES]}
    answer = subprocess.run(
        ["node", "-e", script, str(out)], env=environment, capture_output=True, check=True
    )
    found = json.loads(answer.stdout)
    assert (found["warnings"], found["errors"]) == ([], [])
    samples, rows = given.samples, found["records"]
    assert len(rows) == len(samples)
    times = [datetime.fromisoformat(row["time"]).timestamp() for row in rows]
    assert np.abs(np.array(times) - samples.utc_s).max() <= 1e-3
    places = np.array(
        [(row["position"]["PositionNorth"], row["position"]["PositionEast"]) for row in rows]
    )
    assert np.abs(places[:, 0] - samples.latitude_deg).max() <= 1e-7
    info = next(each for each in found["info"] if each["valueKey"] == "0002_DET-2")
    assert info["unit"] == "L/ha"
    rates = info["scale"] * np.array([row["values"]["0002_DET-2"] for row in rows])
    np.testing.assert_allclose(rates, samples.applied_l_ha, rtol=1e-3, atol=1e-3)

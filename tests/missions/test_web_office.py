"""The office on the operator's page: files are read and planned by children with limits."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from fastapi import APIRouter, HTTPException

from companion.cli.app import execute
from companion.web.parts import Host, Limits, registered, uploads
from missions.web import office as module
from missions.web.office import Office
from tests.companion.web_site import OPERATE, VIEW, Reply, Site, served, until

ANYANG = Path(__file__).resolve().parents[2] / "examples" / "anyang"
CONFIG = ["--config", str(ANYANG / "config.toml")]
BYTES = {"Content-Type": "application/octet-stream"}
# Planning computes, and a computer that runs all tests has much to do.
pytestmark = pytest.mark.timeout(300)
IN_LOOP = pytest.mark.asyncio(loop_scope="module")
OFFICE = "/api/v1/office"
FOLDERS: dict[int, Path] = {}
SQUARE = {
    "type": "Polygon",
    "coordinates": [[[8.0, 47.0], [8.001, 47.0], [8.001, 47.0004], [8.0, 47.0004], [8.0, 47.0]]],
}
# In the middle of the field of Anyang.
GARDEN = {
    "type": "Polygon",
    "coordinates": [
        [[114.5437, 35.9965], [114.5438, 35.9965], [114.5438, 35.9966], [114.5437, 35.9965]]
    ],
}


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def site(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Site]:
    folder = tmp_path_factory.mktemp("office")
    host = {"folder": str(folder), "config": CONFIG, "upload_link": "", "journals": ""}
    async with served(host=host) as found:
        await on_ground(found)
        FOLDERS[found.port] = folder
        yield found


async def on_ground(site: Site, *, armed: bool = False) -> None:
    site.show(armed=armed, in_air=False)
    await until(lambda: (site.ask("GET", OFFICE).json["not_now"] is not None) == armed)


async def load(site: Site, name: str, data: bytes, **headers: str) -> Reply:
    path = f"{OFFICE}/files/{name}"
    reply: Reply = await site.asked("POST", path, data, BYTES | headers)
    return reply


async def do(site: Site, what: str, **body: Any) -> Any:
    reply = await site.asked("POST", f"{OFFICE}/{what}", body)
    assert reply.status == 200, reply.body
    return reply.json


async def load_anyang(site: Site) -> None:
    for path in ANYANG.glob("prescription.*"):
        assert (await load(site, path.name, path.read_bytes())).status == 200
    assert (await load(site, "boundary.geojson", (ANYANG / "boundary.geojson").read_bytes())).json


@IN_LOOP
@pytest.mark.timeout(600)
async def test_a_field_is_loaded_checked_planned_and_its_files_downloaded(site: Site) -> None:
    await load_anyang(site)
    checked = await do(site, "check", file="prescription.shp", rate_field="rate")
    assert checked["check"]["error"] is None
    assert checked["check"]["found"]["zones"] == 40
    zones = (await site.asked("GET", f"{OFFICE}/made/zones.geojson")).json
    assert len(zones["features"]) == 40
    state = await do(
        site, "plan", field="boundary.geojson", prescription="prescription.shp",
        rate_field="rate", tank_l=4, speed_m_s=4, depot=[35.9962, 114.5434],
    )  # fmt: skip
    plan = state["plan"]
    assert plan["error"] is None
    found = plan["found"]
    assert len(found["sorties"]) >= 2
    # The sum over the map, by a fifth more at most: places that are covered twice.
    assert 1.0 <= found["volume_l"] / checked["check"]["found"]["litres"] <= 1.2
    assert sum(one["volume_l"] for one in found["sorties"]) == pytest.approx(found["volume_l"])
    assert all(one["fill_l"] <= 4.0 for one in found["sorties"])
    assert plan["flight_map"]["error"] is None
    made = {one["name"]: one["bytes"] for one in state["made"]}
    assert {*plan["files"], "field.lines.geojson", "field.flightmap.gpkg", "sheet.html"} <= {*made}
    first = await site.asked("GET", f"{OFFICE}/made/{plan['files'][0]}")
    assert json.loads(first.body)["fileType"] == "Plan"
    sheet = await site.asked("GET", f"{OFFICE}/made/sheet.html")
    assert sheet.headers["content-type"] == "application/octet-stream"
    assert "sandbox" in sheet.headers["content-security-policy"]
    assert sheet.headers["content-disposition"].startswith("attachment")


def samples() -> bytes:
    """Return points over the field of Anyang: low in the south, high in the north."""
    rows = ["lat,lon,vigour"]
    for north in range(25):
        for east in range(9):
            lat, lon = 35.99595 + north * 5e-5, 114.54340 + east * 8e-5
            rows.append(f"{lat:.6f},{lon:.6f},{1.0 if lat < 35.9966 else 2.0}")
    return "\n".join([*rows, ""]).encode()


@IN_LOOP
async def test_zones_are_made_of_data_and_are_then_a_map_like_any_other(site: Site) -> None:
    await load_anyang(site)
    assert (await load(site, "samples.csv", samples())).status == 200
    asked = {"data": "samples.csv", "value": "vigour", "field": "boundary.geojson"}
    state = await do(site, "make", **asked, rates_l_ha=[24, 16])
    made = state["make"]
    assert (made["error"], made["file"]) == (None, "made-prescription.gpkg")
    assert [zone["rate_l_ha"] for zone in made["found"]["zones"]] == [24, 16]
    assert [zone["mean_value"] for zone in made["found"]["zones"]] == pytest.approx([1, 2], abs=0.1)
    assert made["file"] in [one["name"] for one in state["files"]]
    assert made["file"] not in [one["name"] for one in state["made"]]
    state = await do(site, "check", file=made["file"])
    assert state["check"]["error"] is None
    assert state["check"]["found"]["rates_l_ha"] == [16, 24]
    assert state["check"]["found"]["litres"] == pytest.approx(made["found"]["litres"], rel=1e-3)
    state = await do(site, "make", **asked, rates_l_ha=[24, 16], litres_max=4, across="valve")
    assert state["make"]["found"]["litres"] <= 4.0
    assert "check" not in state, "of the map before"


@IN_LOOP
async def test_spots_and_a_trial_are_made_checked_and_planned_as_zones_are(site: Site) -> None:
    await load_anyang(site)
    weeds = samples().decode().splitlines()[:1] + samples().decode().splitlines()[110:116]
    assert (await load(site, "weeds.csv", "\n".join([*weeds, ""]).encode())).status == 200
    asked = {"kind": "spots", "data": "weeds.csv", "field": "boundary.geojson"}
    state = await do(site, "make", **asked, rates_l_ha=[20], wind_m_s=0.5)
    made = state["make"]
    assert (made["error"], made["kind"], made["found"]["weeds"] > 0) == (None, "spots", True)
    assert 0.0 < made["found"]["litres"] < 2.0
    more = await do(site, "make", **asked, rates_l_ha=[20], wind_m_s=3)
    assert more["make"]["found"]["treated_ha"] > made["found"]["treated_ha"]
    trial = {"kind": "trial", "field": "boundary.geojson", "rates_l_ha": [15, 25], "rest_l_ha": 20}
    state = await do(site, "make", **trial, blocks=2, seed=7)
    assert "do not fit into the field" in state["make"]["error"]
    state = await do(site, "make", **trial, blocks=2, seed=7, plot_m=15)
    assert state["make"]["error"] is None
    assert [len(state["make"]["found"]["plots"]), state["make"]["found"]["seed"]] == [4, 7]
    name = "made-prescription.trial.geojson"
    assert name in [one["name"] for one in state["made"]]
    record = json.loads((await site.asked("GET", f"{OFFICE}/made/{name}")).body)
    assert record["trial"]["treatments_l_ha"] == [15, 25]
    checked = await do(site, "check", file="made-prescription.gpkg")
    assert checked["check"]["found"]["rates_l_ha"] == [15, 20, 25]
    planned = await do(
        site, "plan", field="boundary.geojson", prescription="made-prescription.gpkg",
        angle_deg=state["make"]["found"]["course_deg"],
    )  # fmt: skip
    assert planned["plan"]["error"] is None
    for change in (
        {**asked, "rates_l_ha": [20, 30]}, {**asked, "data": None, "rates_l_ha": [20]},
        {**trial, "data": "weeds.csv"}, {**trial, "rest_l_ha": None}, {**trial, "blocks": 1},
        {**trial, "kind": "report"},
    ):  # fmt: skip
        assert (await site.asked("POST", f"{OFFICE}/make", change)).status == 422, change


@IN_LOOP
async def test_data_that_make_no_zones_are_refused_in_one_line_and_leave_no_map(site: Site) -> None:
    await load_anyang(site)
    await load(site, "samples.csv", samples())
    asked = {"data": "samples.csv", "value": "vigour", "field": "boundary.geojson"}
    assert (await do(site, "make", **asked, rates_l_ha=[24, 16]))["make"]["error"] is None
    for change, said in (
        ({"value": "--out=x"}, "--out=x"),
        ({"value": "weeds"}, "it has no column 'weeds' of numbers; it has vigour"),
        ({"data": "boundary.geojson", "value": "vigour"}, "given/boundary.geojson"),
    ):
        state = await do(site, "make", **{**asked, "rates_l_ha": [24, 16], **change})
        error = state["make"]["error"]
        assert error and said in error and "\n" not in error
        assert "made-prescription.gpkg" not in [one["name"] for one in state["files"]]
    for change, status in (
        ({"data": "none.tif"}, 404), ({"field": "none.geojson"}, 404),
        ({"no_spray": ["none.kml"]}, 404), ({"data": "../config.toml"}, 422),
        ({"rates_l_ha": []}, 422), ({"rates_l_ha": [-1]}, 422), ({"angle_deg": 360}, 422),
        ({"as_is": True}, 422),
    ):  # fmt: skip
        reply = await site.asked("POST", f"{OFFICE}/make", {**asked, "rates_l_ha": [1], **change})
        assert reply.status == status, change


async def test_without_a_configuration_no_zones_are_made(tmp_path: Path) -> None:
    found = office(tmp_path)
    for name in ("a.csv", "b.geojson"):
        (found.given / name).write_text("x")
    with pytest.raises(HTTPException, match="start vrspray run with a configuration"):
        await found.make(module.Making(data="a.csv", field="b.geojson", rates_l_ha=[20.0]))


@IN_LOOP
async def test_what_the_command_line_refuses_is_refused_with_its_line(
    site: Site, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (await load(site, "bad.geojson", b'{"type": "FeatureCollection"')).status == 200
    state = await do(site, "check", file="bad.geojson")
    with monkeypatch.context() as patch:
        patch.chdir(await folder_of(site))
        assert execute(["map", "check", "given/bad.geojson", "--json"]) == 2
    assert state["check"]["error"] == json.loads(capsys.readouterr().out)["error"]
    assert "given/bad.geojson" in state["check"]["error"]
    state = await do(site, "plan", field="bad.geojson", rate_l_ha=20)
    assert state["plan"]["error"].startswith("given/bad.geojson")
    assert "\n" not in state["plan"]["error"]


async def folder_of(site: Site) -> Path:
    host = json.loads(site.page._about)["host"]
    return Path(host["folder"]) / "office"


@IN_LOOP
@pytest.mark.parametrize(
    ("name", "status"),
    [
        ("..%2Fevil.geojson", 404), ("%2e%2e", 422), (".hidden.geojson", 422),
        ("--help.geojson", 422), ("x.py", 422), ("x.toml", 422), ("a%00b.geojson", 422),
        ("a%0ab.geojson", 422), ("x" * 90 + ".csv", 422), ("%F0%9F%98%80.csv", 422),
        ("%C3%A4" * 70 + ".csv", 200), ("%F0%9D%94%B8" * 60 + ".csv", 422),
    ],
)  # fmt: skip
async def test_a_file_is_a_name_of_a_map_and_never_a_path(
    site: Site, name: str, status: int
) -> None:
    assert (await load(site, name, b"x")).status == status
    assert not list((await folder_of(site)).parent.glob("*evil*"))


async def test_only_an_operator_loads_and_only_from_the_page_itself(tmp_path: Path) -> None:
    host = {"folder": str(tmp_path), "config": [], "upload_link": "", "journals": ""}
    async with served(is_local=False, host=host) as site:
        for token, status in ((VIEW, 403), ("", 401), ("x" * 43, 401)):
            reply = await load(site, "a.csv", b"x", Authorization=f"Bearer {token}")
            assert reply.status == status
        mine = {"Authorization": f"Bearer {OPERATE}"}
        assert (await load(site, "a.csv", b"x", **mine, Origin="http://evil.example")).status == 403
        wrong = mine | {"Content-Type": "application/json"}
        assert (await load(site, "a.csv", b"x", **wrong)).status == 415
        form = mine | {"Content-Type": "multipart/form-data"}
        assert (await load(site, "a.csv", b"x", **form)).status == 415
        large = await site.asked("POST", f"{OFFICE}/check", b"x" * 5000, mine)
        assert large.status == 413
        look = {"Authorization": f"Bearer {VIEW}"}
        assert (await site.asked("GET", OFFICE, headers=look)).status == 200
        assert not (tmp_path / "office").exists()


@pytest.mark.timeout(600)
async def test_a_later_plan_writes_over_no_field_and_one_is_flown_by_the_operator_only(
    tmp_path: Path,
) -> None:
    host = {
        "folder": str(tmp_path), "config": CONFIG, "upload_link": "", "journals": "",
        "no_choice": "",
    }  # fmt: skip
    async with served(is_local=False, host=host) as site:
        mine, look = ({"Authorization": f"Bearer {token}"} for token in (OPERATE, VIEW))

        async def asked(what: str, headers: dict[str, str] = mine, **body: Any) -> Reply:
            return await site.asked("POST", f"{OFFICE}/{what}", body, headers)

        site.show(armed=False, in_air=False)
        files = [*ANYANG.glob("prescription.*"), ANYANG / "boundary.geojson"]
        for path in files:
            assert (await load(site, path.name, path.read_bytes(), **mine)).status == 200
        await load(site, "garden.geojson", json.dumps(GARDEN).encode(), **mine)
        wanted = {
            "field": "boundary.geojson",
            "prescription": "prescription.shp",
            "rate_field": "rate",
        }
        plans = [(await asked("plan", **wanted, no_spray=["garden.geojson"])).json["plan"]]
        kept = tmp_path / "office" / "fields"
        before_first = {path.name: path.read_bytes() for path in kept.with_name("made").iterdir()}
        before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
        # Another boundary under the same name, and another plan.
        await load(site, "boundary.geojson", json.dumps(SQUARE).encode(), **mine)
        await load(site, "boundary.geojson", (ANYANG / "boundary.geojson").read_bytes(), **mine)
        plans.append((await asked("plan", **wanted, speed_m_s=4)).json["plan"])
        first, second = (plan["flight_map"] for plan in plans)
        assert first["error"] is None
        assert second["error"] is None
        assert [first["field"], second["field"]] == ["0001-boundary", "0002-boundary"]
        assert all(path.read_bytes() == data for path, data in before.items())
        named = [
            *first["settings"].values(),
            *json.loads(first["settings"]["prescription.exclusions"]),
        ]
        assert [Path(one) in before for one in named if one.startswith("/")] == [True] * 4
        assert not {*first["settings"].values()} & {*second["settings"].values()} - {"rate"}
        # Looking is not enough, and a field is one that was planned here.
        assert (await asked("fly", look, field="0001-boundary")).status == 403
        for field in ("0009-other", "..", "0001-boundary/.."):
            assert (await asked("fly", field=field)).status in (404, 422)
        site.show(armed=True, in_air=False)
        await until(lambda: site.ask("GET", OFFICE, headers=look).json["not_now"] is not None)
        assert (await asked("fly", field="0001-boundary")).status == 409
        assert not site.orders
        site.show(armed=False, in_air=False)
        await until(lambda: site.ask("GET", OFFICE, headers=look).json["not_now"] is None)
        assert (await asked("fly", field="0001-boundary")).status == 200
        assert [(one.name, dict(one.said)) for one in site.orders] == [
            ("field", {"field": "0001-boundary"})
        ]
        proposed = json.loads((tmp_path / "field-proposed.json").read_text())
        assert proposed == {"field": "0001-boundary", "settings": first["settings"]}
        # What a start would refuse is refused while somebody can still choose.
        (kept / "0001-boundary" / "field.flightmap.gpkg").write_bytes(b"no map")
        refused = await asked("fly", field="0001-boundary")
        assert refused.status == 409
        assert "prescription.file" in refused.json["detail"]
        assert len(site.orders) == 1
        newest = {path.name: path.read_bytes() for path in (kept.parent / "made").iterdir()}
    # Started again with the first field: its plan is shown, and its mission is what is uploaded.
    async with served(host=host | {"flown": "0001-boundary"}) as site:
        shown = site.ask("GET", OFFICE).json
        assert shown["plan"] == plans[0]
        assert {one["name"] for one in shown["made"]} == newest.keys()
        mission = kept.parent / "made" / "field.plan"
        assert mission.read_bytes() == before_first["field.plan"] != newest["field.plan"]


async def test_without_leave_of_the_configuration_no_field_is_flown(tmp_path: Path) -> None:
    host = {
        "folder": str(tmp_path), "config": CONFIG, "upload_link": "", "journals": "",
        "no_choice": "set web.choose_field = true",
    }  # fmt: skip
    async with served(host=host) as site:
        site.show(armed=False, in_air=False)
        await until(lambda: site.ask("GET", OFFICE).json["not_now"] is None)
        reply = await site.asked("POST", f"{OFFICE}/fly", {"field": None})
        assert (reply.status, reply.json["detail"]) == (409, "set web.choose_field = true")
        assert not site.orders


@IN_LOOP
async def test_nothing_begins_while_the_vehicle_is_armed(site: Site) -> None:
    await load(site, "a.geojson", json.dumps(SQUARE).encode())
    await on_ground(site, armed=True)
    assert (await load(site, "b.geojson", b"x")).status == 409
    for what, body in (
        ("check", {"file": "a.geojson"}), ("plan", {"field": "a.geojson"}),
        ("make", {"data": "a.geojson", "field": "a.geojson", "rates_l_ha": [1]}),
        ("remove", {"file": "a.geojson"}), ("upload", {"file": "field.plan"}),
    ):  # fmt: skip
        reply = await site.asked("POST", f"{OFFICE}/{what}", body)
        assert reply.status == 409
        assert reply.json["detail"] == "the vehicle is armed: disarm it first"
    await on_ground(site)
    assert (await site.asked("POST", f"{OFFICE}/upload", {"file": "field.plan"})).status == 409


@IN_LOOP
async def test_files_are_limited_in_number(site: Site) -> None:
    for number in range(module.FILES_MAX):
        reply = await load(site, f"many-{number}.csv", b"x")
        if reply.status != 200:
            break
    assert reply.status == 413
    for one in (await site.asked("GET", OFFICE)).json["files"]:
        await do(site, "remove", file=one["name"])
    assert (await site.asked("POST", f"{OFFICE}/remove", {"file": "many-1.csv"})).status == 404


# ----------------------------------------------------------------------- children, by themselves


def office(folder: Path, flying: Any = lambda: None) -> Office:
    found = Office(Host(folder=str(folder), config=[], upload_link="", journals="", flying=flying))
    found.given.mkdir(parents=True)
    found.made.mkdir()
    return found


class Large:
    """A request that never ends."""

    headers: Mapping[str, str] = {}

    async def stream(self) -> AsyncIterator[bytes]:
        while True:
            yield b"x" * 100_000


async def test_a_file_without_end_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FILE_BYTES_MAX", 1_000_000)
    found = office(tmp_path)
    with pytest.raises(HTTPException) as refused:
        await found.receive("a.csv", Large())  # type: ignore[arg-type]
    assert refused.value.status_code == 413
    assert not [name for _, _, names in os.walk(tmp_path) for name in names]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("x = bytearray(4_000_000_000)", "2 GB of memory"),
        ("while True: pass", "1 s of computing"),
        ("import time; time.sleep(60)", "longer than 2 s"),
        ("import os; os.abort()", "2 GB of memory"),
    ],
)
async def test_a_child_ends_at_its_limits_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, words: str
) -> None:
    await _with_child(tmp_path, monkeypatch, code)
    if "longer" in words:
        monkeypatch.setattr(module, "TIMES", {"check": Limits(cpu_s=10, wait_s=2.0)})
    done = await office(tmp_path / "field").run("check", [])
    assert done.error is not None
    assert words in done.error
    assert "\n" not in done.error


async def test_a_child_and_its_own_children_end_when_the_vehicle_is_armed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = (
        "import subprocess, time\n"
        "child = subprocess.Popen(['sleep', '300'])\n"
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(child.pid))\n"
        "time.sleep(300)"
    )
    await _with_child(tmp_path, monkeypatch, code)
    pid = tmp_path / "pid"
    reason = "the vehicle is armed: disarm it first"
    found = office(tmp_path / "field", lambda: reason if pid.exists() and pid.read_text() else None)
    monkeypatch.setattr(module, "TIMES", {"check": Limits(cpu_s=10, wait_s=60.0)})
    assert (await found.run("check", [])).error == reason
    # Told to end, it does so when it is its turn on a processor.
    await until(lambda: not alive(int(pid.read_text())))


async def test_work_that_fails_leaves_the_office_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = office(tmp_path)
    (found.given / "a.csv").write_text("x")

    async def failing(self: Office, task: str, words: Any) -> None:
        assert self.host.work.task == task
        raise OSError("no processes left")

    monkeypatch.setattr(Office, "run", failing)
    with pytest.raises(OSError, match="no processes"):
        await found.check(module.Check(file="a.csv"))
    assert found.host.work.task is None


def alive(pid: int) -> bool:
    """Return whether a process runs; one that nobody has asked about yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


async def _with_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Have children run this in place of our own commands."""
    script = tmp_path / "python"
    script.write_text(f"#!{sys.executable}\n{code}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    monkeypatch.setattr(module, "TIMES", {"check": Limits(cpu_s=1, wait_s=100.0)})


async def test_the_page_of_the_office_has_the_head_that_all_parts_have() -> None:
    async with served() as site:
        page = (await site.asked("GET", "/office/")).body.decode()
        assert "<title>Field and plan · vrspray</title>" in page
        assert '<strong id="state-word">FIELD AND PLAN</strong>' in page
        assert 'id="stop"' in page
        assert page.index('src="office.js"') < page.index('<main id="main">')
        assert page.rstrip().endswith("</html>")
        assert (await site.asked("GET", "/office/static")).status == 404


def test_the_page_finds_the_office_by_its_entry_point() -> None:
    parts = registered()
    assert parts["office"] is module.PART
    assert uploads(parts) == ("/api/v1/office/files/",)
    for suffix in ("html", "js", "css"):
        assert list(parts["office"].static.glob(f"*.{suffix}"))
    router = APIRouter()
    host = Host(folder=os.devnull, config=[], upload_link="", journals="", flying=lambda: None)
    parts["office"].add(router, host)
    assert len(router.routes) == 9

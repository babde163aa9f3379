"""Flights on the operator's page: listed, reported and continued by children with limits."""

from __future__ import annotations

import json
import random
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from analysis.replay import FlownCore
from companion.journal.journal import Journal
from companion.web.parts import journal_to_read, registered
from tests.analysis.report_flight import fly
from tests.analysis.test_replay import inputs_of
from tests.builders import setup
from tests.companion.web_site import OPERATE, VIEW, Site, served, until

pytestmark = pytest.mark.timeout(300)
IN_LOOP = pytest.mark.asyncio(loop_scope="module")
FLIGHTS = "/api/v1/flights"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("flights")
    fly(found)
    return found


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def site(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Site]:
    host = {
        "folder": str(tmp_path_factory.mktemp("state")), "config": [], "upload_link": "",
        "journals": str(folder),
    }  # fmt: skip
    async with served(host=host) as found:
        await on_ground(found)
        yield found


async def on_ground(site: Site, *, armed: bool = False) -> None:
    site.show(armed=armed, in_air=False)
    await until(lambda: (site.ask("GET", FLIGHTS).json["not_now"] is not None) == armed)


@IN_LOOP
async def test_a_flight_is_listed_and_its_report_is_made_and_shown(site: Site) -> None:
    listed = (await site.asked("POST", f"{FLIGHTS}/look")).json
    assert [one["file"] for one in listed["flights"]] == ["flight-0001.gpkg"]
    assert listed["flights"][0]["state"] == "closed"
    made = (await site.asked("POST", f"{FLIGHTS}/report", {"file": "flight-0001.gpkg"})).json
    report = made["report"]
    assert report["error"] is None
    assert not report["is_open"]
    assert "L applied" in report["verdict"]["sentence"]
    assert {"report.html", "report.json", "application-generic.csv"} <= {*report["files"]}
    assert (report["left"] is None) != (report["left_error"] is None)
    page = await site.asked("GET", f"{FLIGHTS}/made/flight-0001/report.html")
    assert page.headers["content-type"].startswith("text/html")
    # It is shown, and may neither run nor ask for anything.
    assert "sandbox" in page.headers["content-security-policy"]
    assert "script-src" not in page.headers["content-security-policy"]
    assert b"flight-0001.gpkg" in page.body
    record = await site.asked("GET", f"{FLIGHTS}/made/flight-0001/application-generic.csv")
    assert record.headers["content-disposition"].startswith("attachment")
    assert (await site.asked("GET", FLIGHTS)).json["report"] == report


@IN_LOOP
@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("made/..%2F..%2Fx/report.html", 404), ("made/../report.html", 404),
        ("made/flight-0001/..%2Freport.json", 404), ("made/%2e%2e/flight-0001", 404),
        ("made/flight-0001/none.html", 404),
    ],
)  # fmt: skip
async def test_only_files_of_reports_are_given(site: Site, path: str, status: int) -> None:
    assert (await site.asked("GET", f"{FLIGHTS}/{path}")).status == status


@IN_LOOP
@pytest.mark.parametrize(
    ("name", "status"),
    [("none.gpkg", 404), ("../flight-0001.gpkg", 422), ("config.toml", 404), ("--help", 422)],
)
async def test_only_journals_of_the_folder_are_read(site: Site, name: str, status: int) -> None:
    assert (await site.asked("POST", f"{FLIGHTS}/report", {"file": name})).status == status


@IN_LOOP
async def test_nothing_is_read_while_the_vehicle_is_armed(site: Site) -> None:
    await on_ground(site, armed=True)
    for what, body in (("look", {}), ("report", {"file": "flight-0001.gpkg"})):
        reply = await site.asked("POST", f"{FLIGHTS}/{what}", body)
        assert reply.status == 409
        assert reply.json["detail"] == "the vehicle is armed: disarm it first"
    await on_ground(site)


async def test_who_may_only_look_has_nothing_worked_out(tmp_path: Path) -> None:
    host = {"folder": str(tmp_path), "config": [], "upload_link": "", "journals": str(tmp_path)}
    async with served(is_local=False, host=host) as site:
        for token, get, post in ((VIEW, 200, 403), ("", 401, 401), (OPERATE, 200, 409)):
            mine = {"Authorization": f"Bearer {token}"}
            assert (await site.asked("GET", FLIGHTS, headers=mine)).status == get
            assert (await site.asked("POST", f"{FLIGHTS}/look", {}, mine)).status == post


async def test_a_flight_that_is_still_recorded_is_reported_from_a_copy(tmp_path: Path) -> None:
    """Its run holds the journal: no other process may open it."""
    given, chance = setup(), random.Random(7)
    core = FlownCore(given)
    journals, state = tmp_path / "flights", tmp_path / "state"
    host = {"folder": str(state), "config": [], "upload_link": "", "journals": str(journals)}
    with Journal.create(
        journals, setup=given, setup_text={}, started_s=100.0, waits=True, training="no",
        commit_every_s=0.01,
    ) as journal:  # fmt: skip
        for number in range(260):
            for item in inputs_of(number, given, chance):
                journal.record_input(item)
                core.observe(item)
            journal.record_decision(core.decide(100.0 + number / 20))
        async with served(host=host) as site:
            await on_ground(site)
            reply = await site.asked("POST", f"{FLIGHTS}/report", {"file": journal.path.name})
            report = reply.json["report"]
            assert report["error"] is None, report["error"]
            assert report["is_open"]
            assert "L applied" in report["verdict"]["sentence"]
            assert not list((state / "reports").glob("*.gpkg*"))
    with journal_to_read(journal.path, tmp_path) as path:
        assert path == journal.path  # closed: it is read itself


def test_a_copy_of_a_journal_that_keeps_changing_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, copies = tmp_path / "flight-0001.gpkg", tmp_path / "copies"
    copies.mkdir()
    journal.write_bytes(b"pages")
    log = tmp_path / "flight-0001.gpkg-wal"
    log.write_bytes(b"log")
    counted = iter(range(100))
    monkeypatch.setattr("companion.web.parts._moment", lambda *_: (next(counted), 0, b""))
    with pytest.raises(OSError, match="is being written"), journal_to_read(journal, copies):
        pass
    assert not list(copies.iterdir())
    assert (journal.read_bytes(), log.read_bytes()) == (b"pages", b"log")


async def test_a_computer_that_keeps_nothing_refuses_in_one_line(tmp_path: Path) -> None:
    fly(tmp_path)
    (tmp_path / "state").write_text("no folder")
    host = {
        "folder": str(tmp_path / "state"), "config": [], "upload_link": "",
        "journals": str(tmp_path),
    }  # fmt: skip
    async with served(host=host) as site:
        await on_ground(site)
        for what, body in (("look", {}), ("report", {"file": "flight-0001.gpkg"})):
            reply = await site.asked("POST", f"{FLIGHTS}/{what}", body)
            assert reply.status == 507
            assert reply.json["detail"] == "not done on this computer: not a directory"
        assert (await site.asked("GET", FLIGHTS)).json["task"] is None


def test_the_page_finds_the_flights_by_their_entry_point() -> None:
    part = registered()["flights"]
    assert part.files_at is None
    for suffix in ("html", "js", "css"):
        assert list(part.static.glob(f"*.{suffix}"))
    assert json.dumps(part.title)

"""Flights on the operator's page: after landing their report, and what is left to spray.

No journal is read here: each is handed to `vrspray` itself in a child process with limits. The
journal of the run that serves the page is still being written: a copy of it is read.
"""

from __future__ import annotations

import re
import shutil
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from companion.web.parts import Host, Limits, Outcome, Part, journal_to_read, or_refused, run_child

NAME = re.compile(r"\w[\w .()+-]{0,79}")
LIST = Limits(cpu_s=30, wait_s=90.0)
REPORT = Limits(cpu_s=180, wait_s=600.0)
# Older reports are removed: they can be made anew from their journals.
REPORTS_MAX = 20
SORTIES_MAX = 40
# What a browser may show of a report: the page itself, which asks for nothing and runs nothing.
_SHOWN = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
_KEPT = "default-src 'none'; sandbox"

Name = Annotated[str, Field(pattern=rf"^{NAME.pattern}$", max_length=80)]


class Asked(BaseModel):
    """A journal by its name, and other sorties of its job for the same report."""

    model_config = ConfigDict(extra="forbid")

    file: Name
    also: list[Name] = Field(default=[], max_length=SORTIES_MAX)


@dataclass(slots=True)
class Flights:
    """The journals of the folder, and the report that was asked for last."""

    host: Host
    folder: Path = field(init=False)
    listed: dict[str, Any] = field(default_factory=dict)
    report: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        """Name the folder of the reports; it is made with the first."""
        self.folder = Path(self.host.folder) / "reports"

    def state(self) -> dict[str, Any]:
        """Return the flights as they were found last, and the last report."""
        return {
            "not_now": self.host.flying(),
            "task": self.host.work.task,
            "journals": self.host.journals,
            "config": self.host.config[1] if self.host.config else "CONFIG",
            "report": self.report,
            **self.listed,
        }

    def refuse_now(self) -> None:
        """Refuse while the vehicle is armed or a child works: a 409 with the reason."""
        reason, task = self.host.flying(), self.host.work.task
        if reason is None and task is not None:
            reason = f"busy: {task}; wait until it is done"
        if reason is not None:
            raise HTTPException(409, reason)

    async def look(self) -> dict[str, Any]:
        """Have the folder of journals listed, the newest flight first."""
        self.refuse_now()
        with or_refused(), self.host.work.on("list of flights"):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            words = ["flights", "list", "--folder", self.host.journals or ".", "--json"]
            done = await self._run(words, LIST)
        flights = [{**one, "file": Path(one["file"]).name} for one in done.found.get("flights", [])]
        self.listed = {
            "error": done.error,
            "flights": sorted(flights, key=lambda one: str(one["file"]), reverse=True),
            "free_percent": done.found.get("free_percent"),
        }
        return self.state()

    async def make(self, asked: Asked) -> dict[str, Any]:
        """Write the report of a flight, or of the sorties named; find what is left, and its job."""
        self.refuse_now()
        names = list(dict.fromkeys((asked.file, *asked.also)))
        journals = [Path(self.host.journals) / name for name in names]
        for journal in journals:
            if not self.host.journals or journal.suffix != ".gpkg" or not journal.is_file():
                raise HTTPException(404, f"{journal.name}: no flight of this name in the folder")
        with or_refused(), self.host.work.on("report"):
            self.report = None
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            out = self.folder / f"{journals[0].stem[:60]}{more}"
            shutil.rmtree(out, ignore_errors=True)
            self._make_room()
            out.mkdir(parents=True, mode=0o700)
            with ExitStack() as copies:
                readable = [copies.enter_context(journal_to_read(j, self.folder)) for j in journals]
                paths = [str(each.resolve()) for each in readable]
                report = await self._run(["report", *paths, "--out", out.name, "--json"], REPORT)
                rest = f"{out.name}/rest.geojson"
                words = ["flights", "remaining", *paths, "--out", rest, "--json"]
                left = await self._run(words, REPORT)
            self.report = _told(names, out, report, left) | {
                "is_open": readable != journals,
                "job": await self._job(journals[0]),
            }
        return self.state()

    async def _job(self, journal: Path) -> dict[str, list[str]]:
        """Return the sorties of a flight's job by its plan's id, and flights that may be of it.

        A run's own journal, the newest, is known by its copy, which has no others beside it.
        """
        listed = self.listed.get("flights", [])
        asked = [journal]
        if len(listed) > 1 and listed[0]["state"] == "open":
            other = listed[listed[0]["file"] == journal.name]["file"]
            asked.append(journal.with_name(other))
        found = []
        for each in asked:
            with journal_to_read(each, self.folder) as readable:
                words = ["flights", "job", str(readable.resolve()), "--json"]
                found.append((await self._run(words, LIST)).found)
        job = found[0].get("job")
        same = [its for its in found if its is found[0] or (job and its.get("job") == job)]
        return {
            key: sorted({Path(one["file"]).name for its in same for one in its.get(key, [])})
            for key in ("sorties", "perhaps")
        }

    def _make_room(self) -> None:
        """Remove the oldest reports beyond those that are kept."""
        folders = [path for path in self.folder.glob("*") if path.is_dir()]
        folders.sort(key=lambda path: path.stat().st_mtime)
        for path in folders[: max(len(folders) + 1 - REPORTS_MAX, 0)]:
            shutil.rmtree(path, ignore_errors=True)

    async def _run(self, words: list[str], limits: Limits) -> Outcome:
        return await run_child(words, self.folder, limits, flying=self.host.flying)


def _told(names: list[str], out: Path, report: Outcome, left: Outcome) -> dict[str, Any]:
    """Return what the page says of a report and of what was left."""
    found = report.found
    warnings = found.get("warnings", []) if report.error is None else []
    return {
        "file": names[0],
        "files_of": names,
        "flight": out.name,
        "error": report.error,
        "verdict": found.get("verdict"),
        "marks": [one["text"] for one in warnings if one["severity"] == "mark"],
        "warnings": [one["text"] for one in warnings if one["severity"] == "warning"],
        "files": sorted(path.name for path in out.iterdir() if path.is_file()),
        "left": left.found if left.error is None else None,
        "left_error": left.error,
    }


def add(router: APIRouter, host: Host) -> None:
    """Add the flights' interface to the page."""
    flights = Flights(host)
    busy: dict[int | str, dict[str, Any]] = {
        404: {"description": "no such file"},
        409: {"description": "the vehicle is armed, or something is being worked on"},
        507: {"description": "no room"},
    }

    @router.get("")
    async def state() -> dict[str, Any]:
        """Return the flights and the report that were asked for last."""
        return flights.state()

    @router.post("/look", responses=busy)
    async def look() -> dict[str, Any]:
        """List the flights of the journal folder."""
        return await flights.look()

    @router.post("/report", responses=busy)
    async def report(asked: Asked) -> dict[str, Any]:
        """Evaluate a flight in a child: its report, and what it left."""
        return await flights.make(asked)

    @router.get("/made/{flight}/{name}", responses=busy, response_class=Response)
    async def file(flight: str, name: str) -> Response:
        """Return a file of a report; its page is shown, and may do nothing."""
        path = flights.folder / flight / name
        if not NAME.fullmatch(flight) or not NAME.fullmatch(name) or not path.is_file():
            raise HTTPException(404, "no such file")
        if name == "report.html":
            headers = {"Content-Security-Policy": _SHOWN}
            with suppress(OSError):
                return Response(path.read_bytes(), media_type="text/html", headers=headers)
        return FileResponse(
            path, filename=name, media_type="application/octet-stream",
            headers={"Content-Security-Policy": _KEPT},
        )  # fmt: skip


PART = Part(title="Flights and reports", static=Path(__file__).parent / "static", add=add)

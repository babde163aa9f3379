"""The office's interface: files come in; children make zones, check and plan; files go out.

No file of a stranger is read here: each is handed to `vrspray` itself in a child process with
limits of time and memory, whose one line of refusal is the answer. One child runs at a time, at low
priority, and it ends when the vehicle is armed.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field, model_validator

from companion.atomic_write import write_atomically
from companion.web.parts import (
    Host,
    Limits,
    Outcome,
    Part,
    journal_to_read,
    on_ground,
    or_refused,
    run_child,
)
from missions.reading_fleet import NO_LINES

FILE_BYTES_MAX, ALL_BYTES_MAX, FILES_MAX = 64_000_000, 256_000_000, 60
FLIGHTS_MAX = 50
# What is left for the journals of flights.
FREE_MIN_BYTES = 500_000_000
RECEIVE_WITHIN_S = 300.0
# A file is a name, never a path; what it may hold is the readers' to say.
NAME = re.compile(r"\w[\w .()+-]{0,79}")
NAME_BYTES_MAX = 200
SUFFIXES = (
    *(".shp", ".shx", ".dbf", ".prj", ".cpg", ".geojson", ".json", ".gpkg", ".kml", ".kmz"),
    *(".xml", ".bin", ".tif", ".tiff", ".parquet", ".geoparquet", ".csv", ".txt", ".zip"),
)
TIMES = {
    "make": Limits(cpu_s=300, wait_s=900.0),
    "check": Limits(cpu_s=60, wait_s=180.0),
    "plan": Limits(cpu_s=300, wait_s=900.0),
}
UPLOAD = Limits(cpu_s=60, wait_s=120.0)
# What is made of data: a map like those that are loaded.
MADE_MAP = "made-prescription.gpkg"
# Plots and treatments, for `vrspray trial` after the harvest.
MADE_TRIAL = "made-prescription.trial.geojson"
# What was planned to be flown, each in a folder of its own where nothing is written again.
FIELDS_KEPT = 10
SETTINGS_NAME, RESULTS_NAME = "settings.json", "results.json"
PROPOSED_NAME = "field-proposed.json"

Name = Annotated[str, Field(pattern=rf"^{NAME.pattern}$", max_length=80)]
Places = Annotated[list[Name], Field(max_length=8)]


class _Body(BaseModel):
    """A request's own small JSON: nothing unknown is in it."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Reading(_Body):
    """What a file does not say of itself, as `vrspray map check` takes it."""

    rate_field: Annotated[str, Field(max_length=60)] | None = None
    unit: Annotated[str, Field(max_length=30)] | None = None
    crs: Annotated[str, Field(max_length=60)] | None = None
    layer: Annotated[str, Field(max_length=60)] | None = None

    def words(self) -> list[str]:
        """Return the arguments that say so; a value never reads as an option."""
        given = self.model_dump(include=set(Reading.model_fields), exclude_none=True)
        return [f"--{key.replace('_', '-')}={value}" for key, value in given.items() if value]


class Check(Reading):
    """A prescription map to look at."""

    file: Name


class Making(_Body):
    """What to make: zones of a field's data, spots of its weeds, or a trial, of no data."""

    kind: Literal["zones", "spots", "trial"] = "zones"
    data: Name | None = None
    value: Annotated[str, Field(max_length=60)] | None = None
    rates_l_ha: Annotated[
        list[Annotated[float, Field(ge=0.0, le=1000.0)]], Field(min_length=1, max_length=20)
    ]
    litres_max: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    across: Literal["swath", "valve"] = "swath"
    wind_m_s: Annotated[float, Field(ge=0.0, le=20.0)] | None = None
    rest_l_ha: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None
    blocks: Annotated[int, Field(ge=2, le=50)] | None = None
    seed: Annotated[int, Field(ge=0, le=2**31)] | None = None
    plot_m: Annotated[float, Field(ge=1.0, le=10_000.0)] | None = None
    field: Name
    no_spray: Places = []
    angle_deg: Annotated[float, Field(ge=0.0, lt=360.0)] | None = None
    crs: Annotated[str, Field(max_length=60)] | None = None

    @model_validator(mode="after")
    def _goes_together(self) -> Making:
        if (self.data is None) != (self.kind == "trial"):
            raise ValueError("zones and spots are made of data, a trial of none")
        if self.kind == "spots" and len(self.rates_l_ha) != 1:
            raise ValueError("spots have one rate")
        if self.kind == "trial" and self.rest_l_ha is None:
            raise ValueError("a trial needs the rate of the ground around its plots")
        return self

    def words(self) -> list[str]:
        """Return the command's arguments; a value never reads as an option."""
        rates = ",".join(f"{rate:g}" for rate in self.rates_l_ha)
        words = ["make", self.kind, *([] if self.data is None else [f"given/{self.data}"])]
        words += [f"--rate{'' if self.kind == 'spots' else 's'}={rates}"]
        words += [f"--across={self.across}"] if self.kind == "zones" else []
        words += [f"--boundary=given/{self.field}"]
        words += [f"--no-spray=given/{name}" for name in self.no_spray]
        options = {"angle_deg": "angle-deg", **_OPTIONS[self.kind]}
        for name, option in options.items():
            value = getattr(self, name)
            words += [] if value is None or value == "" else [f"--{option}={value}"]
        return words


# Options of their own, by what is made; what another kind takes is left out.
_OPTIONS: dict[str, dict[str, str]] = {
    "zones": {"litres_max": "litres-max", "value": "value", "crs": "crs"},
    "spots": {"wind_m_s": "wind-m-s", "crs": "crs"},
    "trial": {"rest_l_ha": "rest", "blocks": "blocks", "seed": "seed", "plot_m": "plot-m"},
}


class Planning(Reading):
    """What to plan; what is left out comes from the configuration of the flight."""

    field: Name
    prescription: Name | None = None
    no_spray: Places = []
    obstacle: Places = []
    rate_l_ha: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    swath_m: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    speed_m_s: Annotated[float, Field(gt=0.0, le=30.0)] | None = None
    tank_l: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    border_m: Annotated[float, Field(ge=0.0, le=50.0)] | None = None
    holes: Literal["around", "over"] = "around"
    angle_deg: Annotated[float, Field(ge=0.0, lt=360.0)] | None = None
    depot: tuple[float, float] | None = None
    # A flight whose treated ground is left out: what it left is planned.
    done: Name | None = None
    kind: Literal["plan", "waypoints"] = "plan"

    def settings(self) -> list[str]:
        """Return the arguments of the plan's settings."""
        names = ("rate_l_ha", "swath_m", "speed_m_s", "tank_l", "border_m", "angle_deg")
        given = self.model_dump(include=set(names), exclude_none=True)
        words = [f"--{key.replace('_', '-')}={value:g}" for key, value in given.items()]
        words.append(f"--holes={self.holes}")
        return words if self.depot is None else [*words, f"--depot={self.depot[0]},{self.depot[1]}"]


class Sent(_Body):
    """The planned sortie to put on the vehicle."""

    file: Name


class Named(_Body):
    """A file that came in."""

    file: Name


class Wanted(_Body):
    """The planned field to fly; nothing: the configuration's own."""

    field: Name | None = None


@dataclass(slots=True)
class Office:
    """The files of one field, and the child that works on them."""

    host: Host
    given: Path = field(init=False)
    made: Path = field(init=False)
    fields: Path = field(init=False)
    results: dict[str, Any] = field(default_factory=dict)
    # Files that are arriving, with the bytes that each may still have.
    arriving: dict[str, tuple[str, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Name the folders; they are made when the first file comes."""
        self.given = Path(self.host.folder) / "office" / "given"
        self.made = self.given.with_name("made")
        self.fields = self.given.with_name("fields")
        for part in self.given.parent.glob("*.part"):  # of a page that was ended
            part.unlink(missing_ok=True)
        # Of the field that is flown, plan and missions are at hand again.
        kept = self.fields / self.host.flown
        with suppress(OSError, ValueError):
            results = json.loads((kept / RESULTS_NAME).read_bytes())
            shutil.rmtree(self.made, ignore_errors=True)
            shutil.copytree(kept / "made", self.made)
            self.results = results

    def state(self) -> dict[str, Any]:
        """Return what is there, what was found in it, and why nothing can be done now."""
        return {
            "files": _listed(self.given),
            "made": _listed(self.made),
            "not_now": self.host.flying(),
            "task": self.host.work.task,
            "flights": self.flights(),
            "uploads": bool(self.host.upload_link),
            "fields": [path.parent.name for path in sorted(self.fields.glob(f"*/{SETTINGS_NAME}"))],
            "flown": self.host.flown,
            "no_choice": self.host.no_choice,
            **self.results,
        }

    def path(self, name: str) -> Path:
        """Return a file that came in; a 404 where it is not there."""
        path = self.given / name
        if not _is_name(name) or not path.is_file():
            raise HTTPException(404, f"{name}: not among the files; load it first")
        return path

    def flights(self) -> list[str]:
        """Return the journals of earlier flights, the newest first; none of them is opened."""
        found = Path(self.host.journals).glob("*.gpkg") if self.host.journals else ()
        return sorted((path.name for path in found), reverse=True)[:FLIGHTS_MAX]

    def journal(self, name: str) -> Path:
        """Return the journal of an earlier flight; a 404 where it is not there."""
        if name not in self.flights():
            raise HTTPException(404, f"{name}: no flight of this name in journal.folder")
        return Path(self.host.journals) / name

    async def receive(self, name: str, request: Request) -> None:
        """Write a file as it comes, within the limits of the office, while all is on the ground."""
        self.refuse_now()
        if not _is_name(name) or Path(name).suffix.lower() not in SUFFIXES:
            raise HTTPException(422, f"{name[:80]}: not the name of a map; takes {_kinds()}")
        part = self.given.with_name(f"{os.urandom(8).hex()}.part")
        told = request.headers.get("content-length", "")
        try:
            room = self._room(name)
            if told.isdecimal() and int(told) <= room:
                room = int(told)
            # What comes meanwhile has the rest of the room.
            self.arriving[part.name] = name, room
            async with asyncio.timeout(RECEIVE_WITHIN_S):
                await on_ground(_written(part, name, request, room), flying=self.host.flying)
            part.replace(self.given / name)
        except TimeoutError as error:
            raise HTTPException(408, f"{name}: arrived too slowly; try again") from error
        except OSError as error:
            reason = (error.strerror or "cannot be written").lower()
            raise HTTPException(413, f"{name}: not kept on this computer: {reason}") from error
        finally:
            self.arriving.pop(part.name, None)
            with suppress(OSError):
                part.unlink(missing_ok=True)
        self.results.clear()

    def _room(self, name: str) -> int:
        """Return how many bytes a file may have; a 413 where there is no room for it."""
        self.given.mkdir(parents=True, exist_ok=True, mode=0o700)
        others = [path for path in self.given.iterdir() if path.name != name]
        promised = sum(room for _, room in self.arriving.values())
        room = ALL_BYTES_MAX - sum(path.stat().st_size for path in others)
        room = min(room, shutil.disk_usage(self.given).free - FREE_MIN_BYTES) - promised
        room = min(room, FILE_BYTES_MAX)
        names = {path.name for path in others} | {each for each, _ in self.arriving.values()}
        if len(names - {name}) >= FILES_MAX or room <= 0:
            raise HTTPException(413, "no room for more files: remove some")
        return room

    def refuse_now(self) -> None:
        """Refuse while the vehicle is armed or a child works: a 409 with the reason."""
        reason = self.host.flying()
        task = self.host.work.task
        if reason is None and task is not None:
            reason = f"busy: {task}; wait until it is done"
        if reason is not None:
            raise HTTPException(409, reason)

    # ------------------------------------------------------------------------- what is worked out

    async def make(self, asked: Making) -> dict[str, Any]:
        """Make zones, spots or a trial, as a map among those that were loaded."""
        self.refuse_now()
        for name in (*([asked.data] if asked.data else []), asked.field, *asked.no_spray):
            self.path(name)
        if not self.host.config:
            raise HTTPException(409, "zones fit a sprayer: start vrspray run with a configuration")
        room = self._room(MADE_MAP)
        made = self.made / MADE_MAP
        with self._working("make", MADE_MAP, MADE_TRIAL):
            (self.given / MADE_MAP).unlink(missing_ok=True)  # of other data, or other rates
            out = ["--out", f"made/{MADE_MAP}", "--force", *self.host.config, "--json"]
            done = await self.run("make", [*asked.words(), *out])
            error = done.error
            if error is None and made.stat().st_size > room:
                error = f"{MADE_MAP}: larger than the room for more files: remove some"
            if error is None:
                made.replace(self.given / MADE_MAP)
            self.results.clear()
            self.results["make"] = {
                "kind": asked.kind, "data": asked.data, "file": MADE_MAP, "error": error,
                "found": done.found,
            }  # fmt: skip
        return self.state()

    async def check(self, asked: Check) -> dict[str, Any]:
        """Return what `map check` finds, and have the zones written for the page's map."""
        self.refuse_now()
        self.path(asked.file)
        file, words = f"given/{asked.file}", asked.words()
        zones = self.made / "zones.geojson"
        with self._working("check", "zones.geojson"):
            checked = await self.run("check", ["map", "check", file, *words, "--json"])
            if checked.error is None:
                out = "made/zones.geojson"
                await self.run("check", ["map", "convert", file, out, *words, "--json"])
            self.results["check"] = {
                "file": asked.file, "error": checked.error, "found": checked.found,
                "zones": zones.is_file(),
            }  # fmt: skip
        return self.state()

    async def plan(self, asked: Planning) -> dict[str, Any]:
        """Plan the field, and compile its flight map where there is a prescription."""
        self.refuse_now()
        named = [asked.field, *asked.no_spray, *asked.obstacle]
        for name in [*named, *([asked.prescription] if asked.prescription else [])]:
            self.path(name)
        done = None if asked.done is None else self.journal(asked.done)
        with self._working("plan", "field*", "sheet.html"):
            out = f"made/field.{asked.kind}"
            words = [*_plan_words(asked, self.host, out), "--json"]
            planned = await self._planned(words, done)
            error, found = planned.error, planned.found
            flight_map = None
            if error is None and asked.prescription and self.host.config:
                flight_map = await self._compiled(asked, found.get("lines_file"))
            self.results["plan"] = {
                "error": error, "found": found, "flight_map": flight_map,
                "files": [Path(path).name for path in found.get("files", [])],
            }  # fmt: skip
            if flight_map is not None and flight_map["error"] is None:
                kept = self.fields / flight_map["field"]
                shutil.copytree(self.made, kept / "made", copy_function=_link)
                (kept / RESULTS_NAME).write_text(json.dumps(self.results), encoding="utf-8")
        return self.state()

    async def _planned(self, words: list[str], done: Path | None) -> Outcome:
        """Plan what there is to spray, or what a flight left of it: of its lines, if it had any."""
        if done is None:
            return await self.run("plan", words)
        with or_refused(), journal_to_read(done, self.given.parent) as readable:
            journal = str(readable.resolve())
            planned = await self.run("plan", [*words, "--resume", journal])
            if planned.error is not None and NO_LINES in planned.error:
                planned = await self.run("plan", [*words, "--done", journal])
            return planned

    async def _compiled(self, asked: Planning, lines: str | None) -> dict[str, Any]:
        """Compile the flight map of what was planned, by the configuration of the flight.

        It and its sources have a folder of their own: no later plan writes over what is flown.
        """
        folder = self._folder_of(asked, lines)
        here = f"fields/{folder.name}"
        sets: dict[str, str] = {
            "prescription.file": self._beside(f"{here}/{asked.prescription}"),
            "prescription.boundary": self._beside(f"{here}/{asked.field}"),
            **({"mission.lines": self._beside(f"{here}/{Path(lines).name}")} if lines else {}),
        }
        sets |= {f"prescription.{key}": value for key, value in _answers(asked).items()}
        if asked.no_spray:
            kept_off = [self._beside(f"{here}/{name}") for name in asked.no_spray]
            sets["prescription.exclusions"] = json.dumps(kept_off, ensure_ascii=False)
        file, out = f"{here}/{asked.prescription}", f"{here}/field.flightmap.gpkg"
        command = ["map", "compile", file, "--out", out, *self.host.config, *_set(sets), "--json"]
        done = await self.run("plan", command)
        flown = {**sets, "prescription.file": self._beside(out)}
        if done.error is None:
            _link(self.given.parent / out, self.made / "field.flightmap.gpkg")
            (folder / SETTINGS_NAME).write_text(json.dumps(flown), encoding="utf-8")
        return {
            "error": done.error,
            "problems": done.found.get("problems", []),
            "field": folder.name,
            # What the configuration has to say, for `run` to fly what was planned here.
            "settings": flown,
        }

    def _folder_of(self, asked: Planning, lines: str | None) -> Path:
        """Return a new folder with the files of a plan; the oldest that nobody flies are removed.

        Files are links: what comes later under the name of one is another file.
        """
        self.fields.mkdir(parents=True, exist_ok=True, mode=0o700)
        names = sorted(path.name for path in self.fields.iterdir())
        used = " ".join(
            [*self.host.config, Path(self.host.config[1]).read_text("utf-8", "replace")]
        )
        for name in names[: max(len(names) + 1 - FIELDS_KEPT, 0)]:
            if name != self.host.flown and f"fields/{name}/" not in used:
                shutil.rmtree(self.fields / name, ignore_errors=True)
        number = 1 + max((int(name[:4]) for name in names if name[:4].isdecimal()), default=0)
        folder = self.fields / f"{number:04d}-{Path(asked.field).stem}"[:60]
        folder.mkdir(mode=0o700)
        for path in [*self.given.iterdir(), *([self.given.parent / lines] if lines else [])]:
            _link(path, folder / path.name)
        return folder

    async def fly(self, wanted: Wanted) -> dict[str, Any]:
        """Have the run start anew with a field that was planned here, or with its own."""
        self.refuse_now()
        host, sets = self.host, dict[str, str]()
        if host.no_choice or host.choose is None:
            raise HTTPException(409, host.no_choice)
        if wanted.field is not None:
            file = self.fields / wanted.field / SETTINGS_NAME
            if not _is_name(wanted.field) or not file.is_file():
                raise HTTPException(404, f"{wanted.field}: not planned here; plan first")
            sets = json.loads(file.read_bytes())
        with or_refused(), host.work.on("another field"):
            # What a start would refuse is refused here, where somebody can choose again.
            command = ["config", "check", *host.config, *_set(sets), "--json"]
            done = await run_child(command, self.given.parent, TIMES["check"], flying=host.flying)
            if done.error is not None:
                raise HTTPException(409, done.error)
            proposal = json.dumps({"field": wanted.field, "settings": sets})
            write_atomically(Path(host.folder) / PROPOSED_NAME, proposal.encode(), mode=0o600)
            told = await host.choose(wanted.field or "")
        if not told.accepted:
            raise HTTPException(409, told.text)
        return self.state()

    def _beside(self, name: str) -> str:
        """Return a file as the configuration names it: from its own folder, where it lies below."""
        path = self.given.parent.resolve() / name
        folder = Path(self.host.config[1]).parent
        return str(path.relative_to(folder) if path.is_relative_to(folder) else path)

    async def send(self, asked: Sent) -> dict[str, Any]:
        """Put a planned sortie on the vehicle by the office's second link, and read it back."""
        self.refuse_now()
        if not self.host.upload_link:
            raise HTTPException(409, "web.upload_link names no link to the autopilot for uploads")
        if not (self.made / asked.file).is_file():
            raise HTTPException(404, f"{asked.file}: not planned here; plan first")
        with self._working("upload"):
            words = ["upload", f"made/{asked.file}", "--link", self.host.upload_link, "--json"]
            done = await self.run("upload", words)
            self.results["upload"] = {"file": asked.file, "error": done.error, "found": done.found}
        return self.state()

    @contextmanager
    def _working(self, task: str, *stale: str) -> Iterator[None]:
        """Be busy with a task, whose earlier results are removed."""
        with self.host.work.on(task):
            self.results.pop(task, None)
            self.results.pop("upload", None)
            self.made.mkdir(parents=True, exist_ok=True, mode=0o700)
            for path in [path for name in stale for path in self.made.glob(name)]:
                path.unlink()
            yield

    async def run(self, task: str, words: Sequence[str]) -> Outcome:
        """Run a command of ours within the limits of the task."""
        limits = TIMES.get(task, UPLOAD)
        return await run_child(words, self.given.parent, limits, flying=self.host.flying)


async def _written(part: Path, name: str, request: Request, room: int) -> None:
    """Write a request's body into a file; a 413 where it is larger than there is room."""
    size = 0
    with part.open("xb") as file:
        async for data in request.stream():
            size += len(data)
            if size > room:
                raise HTTPException(413, f"{name}: larger than {room / 1e6:.0f} MB")
            await asyncio.to_thread(file.write, data)


def _set(settings: Mapping[str, str]) -> list[str]:
    return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]


def _link(path: Path | str, link: Path | str) -> None:
    """Give a file one more name; a copy where the disk cannot."""
    Path(link).unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:
        shutil.copyfile(path, link)


def _answers(asked: Planning) -> dict[str, str]:
    """Return what the configuration's prescription table says of the map's file."""
    given = asked.model_dump(include={"rate_field", "unit", "crs", "layer"}, exclude_none=True)
    return {key: value for key, value in given.items() if value}


def _plan_words(asked: Planning, host: Host, out: str) -> list[str]:
    words = ["plan", f"given/{asked.field}", "--out", out, "--force", "--sheet", "made/sheet.html"]
    if asked.prescription:
        words += ["--prescription", f"given/{asked.prescription}"]
    for option in ("no_spray", "obstacle"):
        for name in getattr(asked, option):
            words += [f"--{option.replace('_', '-')}", f"given/{name}"]
    return [*words, *asked.settings(), *asked.words(), *host.config]


def _is_name(name: str) -> bool:
    return NAME.fullmatch(name) is not None and len(os.fsencode(name)) <= NAME_BYTES_MAX


def _kinds() -> str:
    return ", ".join(SUFFIXES)


def _listed(folder: Path) -> list[dict[str, Any]]:
    if not folder.is_dir():
        return []
    paths = sorted(path for path in folder.iterdir() if path.is_file())
    return [{"name": path.name, "bytes": path.stat().st_size} for path in paths]


def add(router: APIRouter, host: Host) -> None:
    """Add the office's interface to the page."""
    office = Office(host)
    busy: dict[int | str, dict[str, Any]] = {
        404: {"description": "no such file"},
        409: {"description": "the vehicle is armed, or a file is being worked on"},
    }

    @router.get("")
    async def state() -> dict[str, Any]:
        """Return the files, what was found in them, and why nothing can be done now."""
        return office.state()

    @router.post("/files/{name}", responses=busy | {408: {"description": "too slow"}})
    async def load(name: str, request: Request) -> dict[str, Any]:
        """Take a file; its body is the file itself."""
        await office.receive(name, request)
        return office.state()

    @router.post("/remove", responses=busy)
    async def remove(named: Named) -> dict[str, Any]:
        """Remove a file that came in."""
        office.refuse_now()
        office.path(named.file).unlink()
        office.results.clear()
        return office.state()

    works: dict[str, Callable[..., Any]] = {
        "make": office.make, "check": office.check, "plan": office.plan, "upload": office.send,
        "fly": office.fly,
    }  # fmt: skip
    for name, work in works.items():
        router.add_api_route(f"/{name}", work, methods=["POST"], responses=busy)

    @router.get("/{place}/{name}", responses=busy, response_class=Response)
    async def file(place: Literal["given", "made"], name: str) -> Response:
        """Return a file; browsers keep it, and never show it as a page."""
        path = (office.given if place == "given" else office.made) / name
        if not _is_name(name) or not path.is_file():
            raise HTTPException(404, "no such file")
        return FileResponse(
            path, filename=name, media_type="application/octet-stream",
            headers={"Content-Security-Policy": "default-src 'none'; sandbox"},
        )  # fmt: skip


PART = Part(
    title="Field and plan", static=Path(__file__).parent / "static", add=add, files_at="files"
)

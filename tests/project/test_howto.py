"""The how-to pages: short, and every command in them is typed.

What needs no vehicle runs in a folder made like a user's, with the example field under the names
that the pages use. The rest, and what takes long, is only read: the command and its options exist.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import typer
from click.testing import Result
from typer.testing import CliRunner

from companion.cli.app import app
from companion.config.model import Config
from companion.link.service import DO_SPRAYER, USER_ESTOP
from tests.compiling_here import compiled_here
from tests.laid_out_once import laid_out_once
from tests.reference.words import words_in

ROOT = Path(__file__).resolve().parents[2]
HOWTO = ROOT / "docs" / "howto"
PAGES = sorted(HOWTO.glob("*.md"))
MOST_WORDS = 800
# A block, indented in a list or not: its language, its title if any, its text.
BLOCK = re.compile(
    r'^(?P<indent> *)```(?P<kind>\w*)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^(?P=indent)```$',
    re.MULTILINE | re.DOTALL,
)
# Commands that need a vehicle, a second terminal, a person at the keys or the internet.
NEEDS_MORE = {
    ("run",), ("upload",), ("doctor",), ("ground",), ("service",), ("sitl", "serve"), ("wsp",),
    ("campaign",),
    ("demo",), ("examples",), ("calibrate", "lag"), ("calibrate", "valves"), ("calibrate", "curve"),
}  # fmt: skip
# Options with which one of these needs nothing else.
ALONE = ("--no-link", "--dry-run", "--catch")
# Pages whose plans or flights would repeat those of others, and take long.
ONLY_READ = re.compile(r"^vrspray (sitl fly|replay|plan .*(--choices|--aircraft|--terrain))")


def blocks(page: Path) -> Iterator[tuple[str, str | None, str]]:
    """Yield kind, title and text of each block of a page, without its indent."""
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        lines = found["text"].splitlines()
        text = "\n".join(line.removeprefix(found["indent"]) for line in lines)
        yield found["kind"], found["title"], text + "\n"


def commands(page: Path, kinds: Collection[str] = ("", "sh", "text")) -> list[str]:
    """Return each `vrspray` command that a page has its reader type, on one line."""
    typed = "".join(text for kind, _, text in blocks(page) if kind in kinds)
    lines = typed.replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip().startswith("vrspray ")]


REAL_FIELDS = ROOT / "docs" / "measurements" / "real-fields.md"
EVERY = [(page.name, command) for page in (*PAGES, REAL_FIELDS) for command in commands(page)]


@cache
def command_at(names: tuple[str, ...]) -> tuple[Any, Any]:
    """Return the command of these names and its context; None where there is none."""
    if not names:
        root: Any = typer.main.get_command(app)
        return root, root.make_context("vrspray", [], None, resilient_parsing=True)
    above, context = command_at(names[:-1])
    found = above.get_command(context, names[-1])
    if found is None:
        return None, None
    return found, found.make_context(names[-1], [], context, resilient_parsing=True)


def leaf(words: list[str]) -> tuple[tuple[str, ...], set[str], list[str]]:
    """Return the names of a command line's command, its options, and what is left for it."""
    names: tuple[str, ...] = ()
    found, context = command_at(names)
    while words and hasattr(found, "list_commands"):
        below, _ = command_at((*names, words[0]))
        if below is None and hasattr(found, "unsaid"):
            words = [found.unsaid, *words]
            below, _ = command_at((*names, words[0]))
        assert below is not None, f"no command {' '.join([*names, words[0]])}"
        names, words = (*names, words[0]), words[1:]
        found, context = command_at(names)
    options = {name for one in found.get_params(context) for name in one.opts}
    more = {name for one in found.get_params(context) for name in one.secondary_opts}
    return names, options | more, words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short(page: Path) -> None:
    assert words_in(page.read_text(encoding="utf-8")) <= MOST_WORDS


@pytest.mark.parametrize(("page", "command"), EVERY)
def test_a_command_and_its_options_exist(page: str, command: str) -> None:
    words = shlex.split(command.split(" #")[0])[1:]
    _, known, rest = leaf([word for word in words if word != "..."])
    assert {word.split("=")[0] for word in rest if re.match(r"--[a-z]", word)} <= known


SETTINGS = [
    (page.name, text)
    for page in PAGES
    for kind, title, text in blocks(page)
    if kind == "toml" and title is None and "[[fault]]" not in text
]


@pytest.mark.parametrize(("page", "text"), SETTINGS)
def test_tables_and_keys_of_a_page_exist(page: str, text: str) -> None:
    schema = Config.model_json_schema(by_alias=True)
    for table, given in tomllib.loads(text).items():
        names = re.findall(r"#/\$defs/(\w+)", json.dumps(schema["properties"][table]))
        known = {key for name in names for key in schema["$defs"][name]["properties"]}
        for one in given if isinstance(given, list) else [given]:
            assert set(one) <= known, page


def runs(command: str) -> bool:
    """Return whether a command runs here, by itself and soon."""
    words = shlex.split(command)[1:]
    names, _, _ = leaf(words)
    if ONLY_READ.match(command) or "FILE" in words or "/etc/" in command:
        return False
    is_alone = any(option in words for option in ALONE)
    return is_alone or not any(names[: len(more)] == more for more in NEEDS_MORE)


# What stands as `text` needs files that a test has not.
RUNNABLE = {page.name: list(filter(runs, commands(page, ("", "sh")))) for page in PAGES}
RUNNING = sorted(page for page, found in RUNNABLE.items() if found)


@pytest.fixture(scope="module", autouse=True)
def lines_of_a_field_are_laid_once() -> Iterator[None]:
    """Most pages plan over the same field: what is asked here is that their commands run."""
    with laid_out_once():
        yield


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder as a reader has it: examples, a configuration, its map, a flight."""
    folder = tmp_path_factory.mktemp("reader")
    shutil.copytree(ROOT / "examples", folder / "examples")
    for one in (ROOT / "examples" / "anyang").iterdir():
        if one.is_file():
            shutil.copy(one, folder / one.name)
    make = [sys.executable, "examples/zones/make.py", "data"]
    subprocess.run(make, cwd=folder, check=True)
    lines = (folder / "mission.waypoints").read_text().splitlines()
    (folder / "short.waypoints").write_text("\n".join(lines[:5]) + "\n")  # one pass of four
    config = ["--config", "examples/anyang/config.toml"]
    fly = ["sitl", "fly", *config, "--mission", "short.waypoints", "--out", "flights"]
    assert vrspray(folder, *fly).exit_code == 0
    plan = ["plan", "boundary.geojson", "--config", "config.toml", "--out", "field.plan"]
    assert vrspray(folder, *plan).exit_code == 0
    compiled = ["prescription.shp", "--config", "config.toml", "--out", "field.flightmap.gpkg"]
    assert vrspray(folder, "map", "compile", *compiled).exit_code == 0
    return folder


def vrspray(within: Path, *words: str) -> Result:
    """Run a command in a folder, in this process and not at the low priority of a command.

    A flight is not compared with one of perfect knowledge: no page has a word of that.
    """
    with pytest.MonkeyPatch.context() as patch, compiled_here():
        patch.chdir(within)
        patch.setattr("companion.cli.app.give_way", lambda *_: None)
        patch.setattr("sitl.fly._perfect", lambda *_: None)
        return CliRunner().invoke(app, words)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", RUNNING)
def test_commands_of_a_page_run(page: str, home: Path, tmp_path: Path) -> None:
    here = shutil.copytree(home, tmp_path / "here")
    for _, title, text in blocks(HOWTO / page):
        if title is not None:
            (here / title).write_text(text, encoding="utf-8")
    for command in RUNNABLE[page]:
        words = shlex.split(command)[1:]
        if words[0] == "plan":  # each of a page's plans is the reader's only one
            stem = Path(words[words.index("--out") + 1]).stem
            for old in here.glob(f"{stem}*") if command.count(stem) == 1 else ():
                old.unlink()
        done = vrspray(here, *words)
        # doctor without a link finds fault with any computer that is not a vehicle's.
        fine = {0, 1} if "doctor" in command else {0}
        assert done.exit_code in fine, f"{command}\n{done.output}{done.exception!r}"


def test_the_shipped_action_file_has_the_buttons_that_the_page_names() -> None:
    shipped = (ROOT / "deploy" / "qgroundcontrol" / "spray.json").read_text(encoding="utf-8")
    actions = json.loads(shipped)["actions"]
    page = (HOWTO / "enable-spraying.md").read_text(encoding="utf-8")
    assert all(f"*{one['label']}*" in page for one in actions)
    assert [one["mavCmd"] for one in actions] == [DO_SPRAYER, DO_SPRAYER, USER_ESTOP]
    assert {one["compId"] for one in actions} == {191}


@pytest.mark.timeout(400)
def test_the_commands_of_a_real_field_run_one_after_the_other(tmp_path: Path) -> None:
    """The page's data are others' and not here: a made-up image takes their name, on 0.1 ha."""
    outline = [(0.0, 0.0), (40.0, 0.0), (40.0, 24.0), (0.0, 24.0)]
    east_m, north_m = 284_000.0, 6_131_000.0  # GDA94, MGA zone 54
    ground = shapely.Polygon([(east_m + x, north_m + y) for x, y in outline])
    name = "area1_onebox_94mga54.shp"
    pyogrio.raw.write(
        tmp_path / name, np.array([shapely.to_wkb(ground)]), [np.array([1])], ["id"],
        geometry_type="Polygon", crs="EPSG:28354",
    )  # fmt: skip
    values = np.full((16, 26), 0.2)
    values[:, 9:] = 0.3
    with rasterio.open(
        tmp_path / "area1_onebox_NDVI_250cm.tif", "w", driver="GTiff", width=26, height=16,
        count=1, dtype="float64", crs="EPSG:28354",
        transform=rasterio.Affine(2.5, 0.0, east_m - 2.5, 0.0, -2.5, north_m + 38.0),
    ) as image:  # fmt: skip
        image.write(values, 1)
    config = tmp_path / "made.toml"
    text = (ROOT / "examples/zones/config.toml").read_text(encoding="utf-8")
    text = text.replace('file = "map.gpkg"', 'file = "made.geojson"')
    config.write_text(text.replace('boundary = "boundary.geojson"', f'boundary = "{name}"'))
    typed = commands(REAL_FIELDS)
    assert [shlex.split(one)[1] for one in typed] == ["make", "plan", "sitl", "report"]
    for command in typed:
        words = shlex.split(command)[1:]
        if words[0] == "make":
            words.append("--json")
        done = vrspray(tmp_path, *words)
        assert done.exit_code == 0, f"{command}\n{done.output}{done.exception!r}"
        if words[0] == "make":
            course = json.loads(done.stdout)["course_deg"]
            said = ('angle_deg = "auto"', f"angle_deg = {course}")
            config.write_text(config.read_text().replace(*said))
        elif words[0] == "plan":
            said = ("[mission]", '[mission]\nlines = "made.lines.geojson"')
            config.write_text(config.read_text().replace(*said))
    assert (tmp_path / "report" / "report.html").is_file()

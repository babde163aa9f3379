"""Command line of the examples: `vrspray examples list` and `vrspray examples copy`.

They are part of the installed package, so that a folder without the source tree has them too.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.answer import AsJson, answer, new_app
from companion.errors import ConfigError

DEPLOY = "deploy"
# What each is, in the order of the list.
ABOUT = {
    "anyang": "the field of Wang et al. 2024: map, configuration, missions, scenarios",
    "orchard": "a made-up field with holes, 0 to 180 L/ha, and a larger sprayer",
    "pinpoint": "a boom with a PWM valve at each nozzle",
    "pump": "one pump whose speed makes the flow, and one valve",
    "pump-sections": "one pump, six on-off sections, a return valve",
    "atomiser": "two rotary atomisers fed by one pump",
    "own-method": "controllers of one's own, for --controller",
    "zones": "a made-up field's data by a script, for vrspray make zones",
    "paper": "a scan of water-sensitive paper, drawn, and where its cards lay on anyang's field",
    "campaigns": "many flights with varied settings, for vrspray campaign",
    "profiles": "wirings of valves on this computer's own lines",
    DEPLOY: "for the vehicle: install script, ArduPilot's watchdog script, systemd unit",
}
# Of a file in another example: `file = "../anyang/prescription.shp"`.
_BESIDE = re.compile(r'"\.\./([\w-]+)/')

app = new_app(
    help="List the examples of this installation, or copy one.",
    epilog="Example: vrspray examples copy anyang --to field",
    no_args_is_help=True,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """One folder that can be copied; `needs` are the others whose files it names."""

    name: str
    about: str
    folder: Path
    needs: tuple[str, ...]


def all_examples() -> dict[str, Example]:
    """Return the examples of this installation by their names."""
    found = {}
    for name, about in ABOUT.items():
        package, *way = ("companion", DEPLOY) if name == DEPLOY else ("sitl", "examples", name)
        folder = Path(str(files(package).joinpath(*way)))
        texts = [path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.toml"))]
        needs = {other for text in texts for other in _BESIDE.findall(text)}
        found[name] = Example(name=name, about=about, folder=folder, needs=tuple(sorted(needs)))
    return found


@app.command("list", epilog="Example: vrspray examples list")
def list_them(as_json: AsJson = False) -> None:
    """List the examples."""
    found = all_examples().values()
    answer(
        {"examples": [{"name": each.name, "about": each.about} for each in found]},
        (f"{each.name:14} {each.about}" for each in found),
        as_json=as_json,
    )


@app.command(epilog="Example: vrspray examples copy anyang")
def copy(
    name: Annotated[str, typer.Argument(help="Name of an example, as `list` prints it.")],
    to: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder to copy it into. Default: examples; deploy: here."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the files of an earlier copy.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Copy an example, with the examples that it needs.

    Without --to, the commands in the documentation work unchanged. Exit 2: no such
    example, or the folder is there already.
    """
    found = all_examples()
    if name not in found:
        raise ConfigError(f"no example is called {name!r}; one of: {', '.join(found)}")
    into = to if to is not None else Path() if name == DEPLOY else Path("examples")
    target = into / name
    if target.exists() and not force:
        raise ConfigError(
            f"{target}: is there already; --force writes over its files, --to DIR copies elsewhere"
        )
    others = [found[other] for other in found[name].needs if force or not (into / other).exists()]
    copied = [path for each in (found[name], *others) for path in _copy(each, into)]
    answer(
        {"name": name, "folder": str(target), "files": [str(path) for path in copied]},
        _lines(found[name], others, into, len(copied)),
        as_json=as_json,
    )


def _copy(example: Example, into: Path) -> Iterator[Path]:
    """Copy the files of an example, and yield each."""
    sources = sorted(path for path in example.folder.rglob("*") if path.is_file())
    for source in sources:
        if source.suffix == ".pyc":
            continue
        path = into / example.name / source.relative_to(example.folder)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, path)
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be written ({error.strerror}); copy elsewhere with --to DIR"
            ) from error
        yield path


def _lines(example: Example, others: list[Example], into: Path, count: int) -> Iterator[str]:
    beside = "".join(f", with {each.name} beside it" for each in others)
    yield f"{into / example.name}: {count} files{beside}"
    config = into / example.name / "config.toml"
    if config.exists():
        yield f"check it: vrspray config check {config}"

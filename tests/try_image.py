"""Carry out the Dockerfile's steps without a container engine: `python -m tests.try_image [ROLE]`.

Both stages go into one temporary folder that stands for the image's root; what only root may do in
an image is left out. Then the image's own commands run there: the demo, a companion, and the health
check beside it. Needs a package index.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = ROOT / "Dockerfile"
# Folders of the image, and what of its steps needs a root and other users.
FOLDERS = ("/opt/vrspray", "/src", "/data", "/home/vrspray")
LEFT_OUT = {"useradd --create-home --uid 1000 vrspray": "true", " --owner vrspray": ""}


class Instruction(NamedTuple):
    """One instruction of a Dockerfile, by the number of its stage."""

    stage: int
    word: str
    argument: str


def instructions(text: str) -> list[Instruction]:
    """Return the instructions, comments and line ends taken out."""
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    found, stage = [], -1
    for line in filter(None, lines.replace("\\\n", " ").splitlines()):
        word, _, argument = line.partition(" ")
        stage += word == "FROM"
        found.append(Instruction(stage, word, argument.strip()))
    return found


def labels(text: str) -> dict[str, str]:
    """Return the labels of the image."""
    lines = [each.argument for each in instructions(text) if each.word == "LABEL"]
    words = [word for line in lines for word in shlex.split(line)]
    return dict(word.split("=", 1) for word in words)


class Image:
    """A folder that stands for the image's root."""

    def __init__(self, root: Path, arguments: Mapping[str, str]) -> None:
        self.root, self.arguments = root, dict(arguments)
        self.folder = root
        bin_ = root / "bin"
        bin_.mkdir()
        (bin_ / "python").symlink_to(os.path.realpath(sys.executable))
        self.base = {**os.environ, "PATH": f"{bin_}:{os.environ['PATH']}", "HOME": str(root)}
        for name in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONDONTWRITEBYTECODE"):
            self.base.pop(name, None)
        self.environment: dict[str, str] = {}

    def inside(self, text: str) -> str:
        """Return a text with the image's folders where they are here."""
        for name in FOLDERS:
            text = re.sub(rf"(?<![\w/.]){name}(?![\w-])", f"{self.root}{name}", text)
        return text

    def run(self, command: list[str], **more: str) -> int:
        """Run a command as a container of the image would."""
        environment = {**self.base, **self.arguments, **self.environment, **more}
        return subprocess.run(
            command, cwd=self.folder, env=environment, stdin=subprocess.DEVNULL, check=False
        ).returncode

    def take(self, each: Instruction) -> None:
        """Carry out one instruction."""
        if each.word == "FROM":
            self.environment = {}
        elif each.word == "ARG":
            name, _, value = each.argument.partition("=")
            self.arguments.setdefault(name, value)
        elif each.word == "ENV":
            for word in shlex.split(each.argument):
                name, _, value = word.partition("=")
                self.environment[name] = self.inside(value).replace("$PATH", self.base["PATH"])
        elif each.word == "WORKDIR":
            self.folder = Path(self.inside(each.argument))
            self.folder.mkdir(parents=True, exist_ok=True)
        elif each.word == "COPY" and not each.argument.startswith("--from"):
            self._copy(each.argument)
        elif each.word == "RUN":
            command = self.inside(each.argument)
            for old, new in LEFT_OUT.items():
                command = command.replace(old, new)
            if self.run(["sh", "-ec", command]) != 0:
                raise SystemExit(f"failed: {each.argument}")

    def _copy(self, argument: str) -> None:
        *sources, target = argument.split()
        into = self.folder / target
        for source in (ROOT / name for name in sources):
            if source.is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, into, symlinks=True, ignore=ignored)
            else:
                into.mkdir(parents=True, exist_ok=True)
                shutil.copy(source, into)


def main() -> None:
    """Make the image's content, and use it."""
    role = sys.argv[1] if len(sys.argv) > 1 else "vehicle"
    text = DOCKERFILE.read_text(encoding="utf-8")
    steps = instructions(text)
    with tempfile.TemporaryDirectory(prefix="vrspray-image-") as folder:
        image = Image(Path(folder), {"ROLE": role})
        for each in steps:
            image.take(each)
        health = next(each.argument for each in steps if each.word == "HEALTHCHECK")
        check = json.loads(health.partition("CMD ")[2])
        alive = Path(folder) / "alive"
        aged = {"VRSPRAY_ALIVE_FILE": str(alive)}
        assert image.run(["vrspray", "demo", "--speed", "5", "--fidelity", "averaged"]) == 0
        assert image.run(check, **aged) == 0, "other commands are healthy"
        config = "examples/anyang/config.toml"
        ports = "link.url=udpin:127.0.0.1:0"
        command = ["vrspray", "run", "--config", config, "--duration-s", "3", "--set", ports]
        assert image.run(command, **aged) == 0
        assert time.time() - alive.stat().st_mtime < 30.0, "the control loop touched the file"
        alive.touch()
        assert image.run(check, **aged) == 0, "a loop that goes is healthy"
        os.utime(alive, (time.time() - 60.0,) * 2)
        assert image.run(check, **aged) != 0, "a loop that stands still is not"
        compiled = list(Path(folder).glob("opt/vrspray/lib/python3*/site-packages/sitl/**/*.pyc"))
        assert compiled, "byte-compiled"
    sys.stdout.write(f"The steps of the Dockerfile work for the role {role}.\n")


if __name__ == "__main__":
    main()

"""A cut of power at every step of writing: what was not synced is gone, and a start works."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from companion.atomic_write import write_atomically
from companion.cli.systemd import write_unit
from companion.link.parameters import read_state, write_state
from companion.link.signing import STATE_NAME, Signing
from missions.maps.model import write_whole

KEY = bytes(range(32))
NOW_S = 1_800_000_000.0
STEPS = ("open", "write", "fsync", "replace")


class PowerCutError(BaseException):
    """The current is gone: no handler of the program runs to any purpose."""


@dataclass
class Disk:
    """Loses what was not synced, as a file system may: names live on, contents do not."""

    cut_at: int
    step: int = 0
    synced: set[int] = field(default_factory=set)

    def attach(self, patch: pytest.MonkeyPatch) -> None:
        for name in STEPS:
            patch.setattr(os, name, self._counted(name, getattr(os, name)))
        patch.setattr(os, "rename", os.replace)

    def _counted(self, name: str, call: Callable[..., object]) -> Callable[..., object]:
        def counted(*given: object, **named: object) -> object:
            self.step += 1
            if self.step == self.cut_at:
                raise PowerCutError
            done = call(*given, **named)
            if name == "fsync":
                found = os.fstat(given[0])  # type: ignore[arg-type]
                if stat.S_ISREG(found.st_mode):
                    self.synced.add(found.st_ino)
            return done

        return counted

    def lose_the_rest(self, folder: Path, before: set[int]) -> None:
        for file in folder.iterdir():
            if file.is_file() and file.stat().st_ino not in self.synced | before:
                os.truncate(file, 0)


def cut(folder: Path, action: Callable[[], object], cut_at: int) -> bool:
    """Do something on a disk whose power goes at a step; return whether that step came."""
    before = {file.stat().st_ino for file in folder.iterdir()}
    disk = Disk(cut_at)
    with pytest.MonkeyPatch.context() as patch:
        disk.attach(patch)
        try:
            action()
            was_cut = False
        except PowerCutError:
            was_cut = True
    disk.lose_the_rest(folder, before)
    return was_cut


def steps() -> range:
    return range(1, 17)


class AtOnce:
    """A thread that has done its work when it was started, so that the cut ends all."""

    def __init__(self, *, target: Callable[..., object], args: tuple[object, ...], **_: object):
        self.start = lambda: target(*args)

    def is_alive(self) -> bool:
        return False

    def join(self, timeout_s: float) -> None:
        pass


def text_of(path: Path) -> bytes:
    return path.read_bytes() if path.exists() else b""


@pytest.mark.parametrize("cut_at", steps())
@pytest.mark.parametrize(
    "write",
    [
        lambda path, text: write_atomically(path, text.encode()),
        lambda path, text: write_whole(path, text.encode()),
        lambda path, text: write_unit(path, text),
        lambda path, text: write_state(path, {text.strip("# \n"): 1.0}),
    ],
    ids=["write_atomically", "write_whole", "write_unit", "write_state"],
)
def test_after_a_cut_a_file_is_as_before_or_as_wanted(
    tmp_path: Path, write: Callable[[Path, str], object], cut_at: int
) -> None:
    path = tmp_path / "file"
    mark = "# Written by `vrspray service install`\n# {}\n"
    write(path, mark.format("old"))
    old = text_of(path)
    cut(tmp_path, lambda: write(path, mark.format("new")), cut_at)
    assert text_of(path) in (old, old.replace(b"old", b"new"))


@pytest.mark.parametrize("cut_at", steps())
def test_after_a_cut_signing_starts_and_no_stamp_comes_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut_at: int
) -> None:
    monkeypatch.setattr("companion.link.signing.threading.Thread", AtOnce)
    now_s = [NOW_S]
    given: list[int] = []

    def fly() -> None:
        guard = Signing(KEY, state_folder=tmp_path, clock=lambda: now_s[0])
        given.append(guard.next_stamp())
        now_s[0] += 6.0
        guard.next_stamp()
        guard.keep()
        guard.wait_until_kept()
        given.append(guard.next_stamp())
        guard.keep(is_last=True)

    fly()
    now_s[0] += 1.0
    cut(tmp_path, fly, cut_at)
    # A computer without a clock of its own: it begins at 1970 again.
    assert Signing(KEY, state_folder=tmp_path, clock=lambda: 0.0).next_stamp() > given[-1]


@pytest.mark.parametrize(
    "content", ["", "{", "{}", "[]", '{"stamp": "x"}', '{"stamp": -1}', '{"stamp": 1e17}', "\0" * 9]
)
def test_a_damaged_stamp_refuses_no_start(
    tmp_path: Path, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / STATE_NAME
    path.write_text(content)
    os.utime(path, (NOW_S, NOW_S))
    guard = Signing(KEY, state_folder=tmp_path, clock=lambda: 0.0)
    # What was written last is older than the file: with that the stamp does not go back.
    assert guard.next_stamp() > round((NOW_S - 1_420_070_400) * 100_000)
    (line,) = [record.getMessage() for record in caplog.records]
    assert str(path) in line
    assert "\n" not in line
    assert read_state(path)["stamp"] > 0


def test_a_full_disk_stops_no_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    guard = Signing(KEY, state_folder=tmp_path, clock=lambda: NOW_S)
    monkeypatch.setattr(os, "write", full)
    guard.keep(is_last=True)
    assert guard.next_stamp() > 0
    assert [file.name for file in tmp_path.iterdir()] == [STATE_NAME]


def test_a_link_in_the_way_of_the_draft_is_not_written_through(tmp_path: Path) -> None:
    target = tmp_path / "elsewhere"
    target.write_text("precious")
    folder = tmp_path / "state"
    folder.mkdir()
    for name in (".a.part", f".a.{os.getpid()}.part", ".a.new"):
        (folder / name).symlink_to(target)
    write_atomically(folder / "a", b"new")
    assert (folder / "a").read_text() == "new"
    assert target.read_text() == "precious"


def test_the_rights_are_those_that_the_system_gives_new_files(tmp_path: Path) -> None:
    (tmp_path / "as-usual").write_text("")
    write_atomically(tmp_path / "a", b"new")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "as-usual").stat().st_mode


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_link_stays_a_link_and_a_pipe_a_pipe(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "path"
    if kind == "link":
        path.symlink_to(tmp_path / "target")
        write_atomically(path, b"new")
        assert path.is_symlink()
        assert (tmp_path / "target").read_text() == "new"
        return
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_atomically(path, b"new")
        assert os.read(reader, 9) == b"new"
    finally:
        os.close(reader)
    assert path.is_fifo()


@pytest.mark.parametrize("fails", [None, "file", "folder"])
def test_no_file_stays_open(
    fails: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync = os.fsync

    def fsync(descriptor: int) -> None:
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        if fails == ("folder" if is_folder else "file"):
            raise OSError("broken")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    path, before = tmp_path / "a.txt", len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        with suppress(OSError):
            write_atomically(path, b"whole")
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    # A folder that cannot be synced is no reason to have no file.
    assert [each.name for each in tmp_path.iterdir()] == ([] if fails == "file" else ["a.txt"])

"""A report is there as a whole or not at all: nothing half made stays, and nothing old is lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from analysis.report.folder import check_folder, earlier_files, write_files
from companion.errors import ConfigError

FILES = {"report.json": b"new", "figures/map.png": b"new", "figures/map.svg": b"new"}


def content(folder: Path) -> dict[str, bytes | None]:
    return {
        str(each.relative_to(folder)): each.read_bytes() if each.is_file() else None
        for each in folder.rglob("*")
    }


def failing_at(count: int, error: BaseException, name: str, patch: pytest.MonkeyPatch) -> None:
    """Let a method of `Path` fail when it is called for the so manieth time."""
    original, left = getattr(Path, name), [count]

    def method(self: Path, *given: object) -> object:
        left[0] -= 1
        if left[0] == 0:
            raise error
        return original(self, *given)

    patch.setattr(Path, name, method)


def test_all_files_are_written_and_replaced(tmp_path: Path) -> None:
    out = tmp_path / "a" / "report"
    write_files(out, dict.fromkeys(FILES, b"old"))
    (out / "mine.txt").write_bytes(b"mine")
    write_files(out, FILES)
    assert content(out) == {**FILES, "figures": None, "mine.txt": b"mine"}


def test_a_look_at_the_folder_makes_none(tmp_path: Path) -> None:
    check_folder(tmp_path / "a" / "b")
    assert content(tmp_path) == {}
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ConfigError, match="not a directory; give a folder that can be written"):
        check_folder(tmp_path / "file" / "report")


def test_what_goes_comes_back_where_anything_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path, {**FILES, "report.pdf": b"old", "figures/lags.png": b"old"})
    before = content(tmp_path)
    left = earlier_files(tmp_path, FILES)
    assert {each.name for each in left} == {"report.pdf", "lags.png"}
    # The last move of all fails: three files are in place, and one is gone already.
    failing_at(8, OSError(28, "No space left on device"), "rename", monkeypatch)
    with pytest.raises(ConfigError):
        write_files(tmp_path, dict.fromkeys(FILES, b"newer"), without=left)
    monkeypatch.undo()
    assert content(tmp_path) == before
    write_files(tmp_path, FILES, without=left)
    assert content(tmp_path) == {**FILES, "figures": None}


FULL = OSError(28, "No space left on device")
FAILURES = [("write_bytes", 2), ("rename", 1), ("rename", 3), ("mkdir", 3)]


@pytest.mark.parametrize("error", [FULL, KeyboardInterrupt()])
@pytest.mark.parametrize(("name", "count"), FAILURES)
def test_what_fails_or_is_interrupted_leaves_nothing(
    name: str, count: int, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing_at(count, error, name, monkeypatch)
    expected = ConfigError if error is FULL else KeyboardInterrupt
    with pytest.raises(expected):
        write_files(tmp_path / "a" / "report", FILES)
    assert content(tmp_path) == {}


@pytest.mark.parametrize(("name", "count"), [("write_bytes", 3), ("rename", 2), ("rename", 4)])
def test_what_was_there_comes_back(
    name: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path, dict.fromkeys(FILES, b"old"))
    before = content(tmp_path)
    failing_at(count, FULL, name, monkeypatch)
    with pytest.raises(ConfigError, match="no space left on device"):
        write_files(tmp_path, FILES)
    assert content(tmp_path) == before


def test_a_folder_in_the_place_of_a_file_is_kept(tmp_path: Path) -> None:
    (tmp_path / "report.json").mkdir()
    (tmp_path / "report.json" / "mine").write_bytes(b"mine")
    before = content(tmp_path)
    with pytest.raises(ConfigError, match=r"report\.json in it is a folder"):
        write_files(tmp_path, FILES)
    assert content(tmp_path) == before

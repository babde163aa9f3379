"""The documentation: its reference pages are those of the code, the site builds, it stays short."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.reference.pages import FOLDER, PAGES, written
from tests.reference.words import GENERATED, WORDS_MAX, counts

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", PAGES)
def test_reference_page_is_that_of_the_code(name: str) -> None:
    current = (FOLDER / name).read_text(encoding="utf-8") == written(name)
    assert current, f"docs/reference/{name} is old: run `make reference` and commit it"


def test_no_command_of_vrspray_offers_to_install_completion_for_itself() -> None:
    assert "--install-completion" not in written("commands.md")


def test_every_page_of_the_reference_is_generated() -> None:
    by_hand = [
        page.name for page in FOLDER.glob("*.md") if not GENERATED.match(page.read_text("utf-8"))
    ]
    assert by_hand == ["index.md"] if (FOLDER / "index.md").exists() else not by_hand


def test_words_are_counted_by_part_and_generated_pages_apart(tmp_path: Path) -> None:
    for name, text in {
        "README.md": "one two",
        "CONTRIBUTING.md": "one",
        "docs/page.md": "# A page\n\n| a | b |\n|---|---|\n",
        "docs/howto/task.md": "do it - now",
        "docs/reference/made.md": "<!-- Written by `make reference` -->\n\nmany words here",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    by_hand, generated = counts(tmp_path)
    assert by_hand == {
        "README.md": 2, "CONTRIBUTING.md": 1, "docs/page.md": 4, "docs/howto": 3,
    }  # fmt: skip
    assert generated == 7


def test_the_documentation_stays_short_enough_to_be_read() -> None:
    by_hand, _ = counts()
    assert sum(by_hand.values()) <= WORDS_MAX, f"cut something: {by_hand}"


def test_site_builds_without_a_broken_link(tmp_path: Path) -> None:
    if shutil.which("mkdocs", path=str(Path(sys.executable).parent)) is None:
        pytest.skip("mkdocs is not installed: make docs installs it")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    result = subprocess.run(
        [*command, "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    start = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    for elsewhere in ("unpkg.com", "fonts.google", "gstatic", "cdn"):
        assert elsewhere not in start

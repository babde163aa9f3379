"""What files, vehicles and names hold is shown as text: it does nothing to the terminal."""

from __future__ import annotations

import io
import json
import os
import sqlite3
import sys
from contextlib import closing, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from companion.cli import live
from companion.cli.answer import answer, note, progress
from companion.cli.app import execute
from companion.cli.drawing import drawn
from companion.cli.live import Shown
from companion.cli.terminal import Styled, shown_as_text, terminal, visible
from tests.companion.test_journal import closed_journal
from tests.json_answers import CONFIG

# Clears the screen, sets the title, the same by C1, hides what follows, turns the order of letters.
EVIL = "\x1b[2J\x1b]0;pwned\x07\x9b2J\x1b[8m\u202ereversed\u2066\r\x7f"
HARMFUL = frozenset("\x1b\x07\x9b\u202e\u2066\r\x7f\x00\x08\u2028")


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


def is_harmless(text: str) -> bool:
    return not HARMFUL & set(text)


@given(text=st.text())
def test_what_is_shown_has_no_controls_and_json_means_the_same(text: str) -> None:
    told = json.dumps({"text": text, "evil": EVIL}, ensure_ascii=False)
    assert json.loads(visible(told)) == {"text": text, "evil": EVIL}
    assert is_harmless(visible(text + EVIL))
    assert visible("Zäune, 20 L/ha\n\t中文") == "Zäune, 20 L/ha\n\t中文"


def test_a_name_that_is_no_text_can_be_said(tmp_path: Path) -> None:
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with redirect_stdout(out), shown_as_text():
        answer({}, [os.fsdecode(b"\xff.shp")], as_json=False)
    out.seek(0)
    assert out.read() == "\\udcff.shp\n"


def test_a_name_with_an_end_of_line_begins_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    forged = "field\nok: nothing to do"
    answer({}, [f"warning: {forged}"], as_json=False)
    note(forged)
    said = capsys.readouterr()
    assert said.out == "warning: field\\nok: nothing to do\n"
    assert said.err == "field\\nok: nothing to do\n"


def evil_map(folder: Path) -> Path:
    ring = [[8.0, 49.0], [8.001, 49.0], [8.001, 49.001], [8.0, 49.0]]
    features = [
        {
            "type": "Feature",
            "properties": {"rate": 20.0, f"name{EVIL}": EVIL, "zone": EVIL},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }
    ]
    path = folder / f"map{EVIL.replace('/', '')}.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def evil_journal(folder: Path) -> Path:
    path = closed_journal(folder / f"flights{EVIL}", 0)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE meta SET value = ? WHERE key = 'method'", (EVIL,))
        connection.execute("INSERT INTO meta (key, value) VALUES (?, ?)", ("training", EVIL))
        connection.execute("INSERT INTO events VALUES (1, ?, 1.0, ?, ?)", (EVIL, EVIL, EVIL))
    return path


def test_no_command_passes_on_what_files_hold(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, flight = str(evil_map(tmp_path)), str(evil_journal(tmp_path))
    broken = tmp_path / "broken.toml"
    shown = 0
    broken.write_text(f'[link]\nurl = "{json.dumps(EVIL)[1:-1]}"\n')
    for arguments in (
        ["map", "check", path],
        ["map", "check", path, "--rate-field", EVIL],
        ["map", "rate", path, "49.0005", "8.0006"],
        ["map", "check", f"{path}.none"],
        ["flights", "list", "--folder", str(Path(flight).parent)],
        ["flights", "show", flight],
        ["report", flight, "--out", str(tmp_path / f"report{EVIL}")],
        ["export", flight, "--out", str(tmp_path / f"out{EVIL}.csv")],
        ["config", "check", str(broken)],
        ["config", "check", CONFIG, "--set", f"link.url={EVIL}"],
        [EVIL],
    ):
        for more in ([], ["--json"]):
            execute([*arguments, *more])
            said = capfd.readouterr()
            shown += "\\u001b[2J" in said.out + said.err
            assert is_harmless(said.out) and is_harmless(said.err), (arguments, said)
            if more and arguments != [EVIL]:
                json.loads(said.out)
    assert shown > 10


def test_bars_blocks_and_lines_of_a_run_show_it_as_text(capfd: pytest.CaptureFixture[str]) -> None:
    err = Tty()
    with redirect_stderr(err), shown_as_text(), progress() as tell:
        tell(EVIL, 1, 2)
        tell(EVIL, 2, 2)
    assert "\x1b[" in err.getvalue() and "\x1b]0;" not in err.getvalue()
    assert "\\u001b]0;pwned" in err.getvalue()
    out = Tty()
    Console(file=out, force_terminal=True).print(drawn(Shown(state="fault", why=EVIL)))
    assert "\x1b]0;" not in out.getvalue() and "pwned" in out.getvalue()
    live._print(EVIL)
    assert is_harmless(capfd.readouterr().err)


def test_colours_of_ours_reach_the_terminal() -> None:
    out = Tty()
    with redirect_stdout(out):
        with shown_as_text(), shown_as_text():
            answer({}, [Styled("\x1b[31mred\x1b[0m"), "\x1b[31mnot"], as_json=False)
            assert terminal(sys.stdout) is out
        assert sys.stdout is out
    assert out.getvalue() == "\x1b[31mred\x1b[0m\n\\u001b[31mnot\n"

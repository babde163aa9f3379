"""The scale weighs what is said, whatever its layout; `make lint` holds it to `weight.toml`."""

from __future__ import annotations

import ast
import textwrap
from pathlib import Path

import pytest

from tools import size

SOURCE = '''
def area_m2(width_m: float, length_m: float) -> float:
    """Return an area."""
    # Both are measured.
    return width_m * length_m + len(f"{width_m:.1f} by {max(length_m, 0.0)}")
'''


def test_layout_weighs_nothing_and_each_word_of_code_does() -> None:
    plain = size.python_size(SOURCE)
    # def, name, 2 x (name, type), arrow, type; return, 3 names and signs, len, f-string.
    assert plain == size.Size(1, 15, 6)
    laid_out = SOURCE.replace("(width_m: float, ", "(\n    width_m: float,\n\n    ")
    assert size.python_size(laid_out) == plain
    unparsed = size.python_size(ast.unparse(ast.parse(SOURCE)))
    assert unparsed == plain._replace(words=3), "a comment is words, and nothing else"
    assert size.python_size(SOURCE.replace("0.0", "-1.0")) == plain, "an f-string is one"


def test_a_package_above_its_ceiling_or_without_one_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = tmp_path / "companion" / "core" / "area.py"
    module.parent.mkdir(parents=True)
    module.write_text(SOURCE)
    weight = tmp_path / "weight.toml"
    weight.write_text('"companion/core" = { tokens = 15, words = 6 }\n')
    assert size.main([str(tmp_path), "--check"]) == 0
    module.write_text(SOURCE + textwrap.dedent("\n# One word more.\nWIDTH_M = 6.0\n"))
    assert size.main([str(tmp_path), "--check"]) == 1
    assert capsys.readouterr().out.count("companion/core: ") == 2
    weight.write_text("")
    assert size.main([str(tmp_path), "--check"]) == 1
    assert "companion/core: has no ceiling" in capsys.readouterr().out

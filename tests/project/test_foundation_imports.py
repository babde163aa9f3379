"""Who imports what: rules of docs/explanation/architecture.md that import-linter lacks."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests import house as rules
from tests.bench import house
from tests.house import imports

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("companion", "missions", "sitl", "analysis")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

# Where each of these may be imported; a folder stands for all below it.
ALLOWED = {
    "pymavlink": ("companion/link", "sitl/stub", "sitl/recorded.py"),
    "mavsdk": ("missions/upload/",),
    "serial": ("companion/link", "sitl/stub"),
    "pydantic": (
        "companion/config",
        "companion/web/server.py",
        "companion/web/entrance.py",
        "missions/web/office.py",
        "analysis/web/flights.py",
        "sitl/scenario_file.py",
        "sitl/stub/faults.py",
        "sitl/stub/sprayer.py",
        "sitl/campaign/design.py",
    ),
    "shapefile": ("missions/maps", "analysis/exports/", "analysis/trial_cli.py"),
}
CORE_ALLOWED = {
    "numpy": None,
    "shapely": {"prescription.py", "outline.py", "cells.py"},
    "pyproj": {"frame.py"},
}
PURE = {
    "__future__", "bisect", "collections", "dataclasses", "enum", "functools", "heapq",
    "itertools", "math", "operator", "statistics", "typing",
}  # fmt: skip


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_all_kinds_of_imports_are_seen() -> None:
    source = "import a.b\nfrom c import d\nif x:\n    from e.f import g as h\n"
    assert list(imports(source)) == ["a.b", "c.d", "e.f.g"]


@pytest.mark.parametrize("library", ALLOWED)
def test_library_is_imported_only_where_it_belongs(library: str) -> None:
    importing = [
        relative(path)
        for path in SOURCES
        if any(name.split(".")[0] == library for name in imports(path.read_text()))
    ]
    assert [name for name in importing if not name.startswith(ALLOWED[library])] == []


def test_mavutil_is_imported_nowhere() -> None:
    everything = [*SOURCES, *(ROOT / "tests").rglob("*.py")]
    importing = [
        relative(path)
        for path in everything
        if "mavutil" in (source := path.read_text())
        and any("mavutil" in name.split(".") for name in imports(source))
    ]
    assert importing == []


def test_the_companion_names_no_module_of_the_office_in_a_string_either() -> None:
    named = re.compile(r"(missions|analysis|sitl)([.:]\w+)+")
    nodes = [
        (path, node)
        for path in (ROOT / "companion").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant | ast.Call)
    ]
    found = [
        f"{relative(path)}:{node.lineno}: {node.value}"
        for path, node in nodes
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and named.fullmatch(node.value)
    ]
    found += [
        f"{relative(path)}:{node.lineno}: {ast.unparse(node)}"
        for path, node in nodes
        if isinstance(node, ast.Call)
        and any(
            isinstance(given, ast.Constant) and given.value in ("missions", "analysis", "sitl")
            for given in node.args
        )
        and ast.unparse(node.func).rpartition(".")[2]
        in ("find_spec", "import_module", "__import__")
    ]
    assert found == []


def test_map_readers_know_nothing_of_planning() -> None:
    found = {
        f"{relative(path)}: {name}"
        for path in (ROOT / "missions" / "maps").rglob("*.py")
        for name in imports(path.read_text())
        if name.startswith("missions.") and not name.startswith("missions.maps.")
    }
    assert found == set()


def test_simulation_never_uses_our_own_link() -> None:
    importing = [
        relative(path)
        for path in (ROOT / "sitl").rglob("*.py")
        if any(name.startswith("companion.link") for name in imports(path.read_text()))
    ]
    assert importing == []


@pytest.mark.parametrize(
    "path",
    [
        *sorted((ROOT / "companion/core").rglob("*.py")),
        ROOT / "companion/ground/work.py",
        ROOT / "companion/ground/clicks.py",
    ],
    ids=lambda path: path.name,
)
def test_core_imports_nothing_that_is_not_pure(path: Path) -> None:
    for name in imports(path.read_text()):
        top = name.split(".")[0]
        if top in CORE_ALLOWED:
            files = CORE_ALLOWED[top]
            assert files is None or path.name in files, f"{path.name} imports {top}"
        else:
            assert top in PURE or name.startswith("companion.core"), f"{path.name} imports {name}"


def test_command_line_imports_other_packages_only_when_they_are_called() -> None:
    names: list[str] = []
    for path in sorted((ROOT / "companion/cli").glob("*.py")):
        body = ast.parse(path.read_text()).body
        at_once = [node for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
        names += imports("\n".join(ast.unparse(node) for node in at_once))
    assert names
    assert [name for name in names if name.split(".")[0] in PACKAGES[1:]] == []


def test_run_loads_what_every_flight_needs_and_no_more() -> None:
    _, _, files = house.loaded(ROOT, tries=1)
    assert len(files) <= 100
    # 17,000 until Part 17, whose rules of motion, floods, guards, stamps, stops are in each.
    # 17,950 until who enabled was recorded, and a field could be chosen on the page.
    assert sum(map(house.code_lines, files)) <= 18_020
    # Each of these is loaded by the configuration that switches it on.
    optional = {
        "companion/config": {"legal_entries", "limits", "motor_rules", "wiring_rules", "wording"},
        "companion/cli": {"drawing", "folders_own", "sensor_parts", "systemd", "web_parts"},
        "companion/link": {"mission_reader", "serial_port", "signing"},
        "companion/output": {"composite", "gpio", "guarded", "hardware_pwm", "pwm", "servo"},
    }
    of_options = {f"{folder}/{name}.py" for folder, names in optional.items() for name in names}
    assert all((ROOT / name).is_file() for name in of_options)
    assert of_options & set(map(relative, files)) == set()


def test_a_function_says_its_lines_without_signature_and_docstring(tmp_path: Path) -> None:
    lines = ["class A:", "    def b(", "        self,", "    ) -> None:", '        """Do."""']
    lines += ["        print()"] * (rules.FUNCTION_LINES_MAX + 1)
    file = tmp_path / "long.py"
    file.write_text("\n".join(lines))
    assert rules.long_functions({"long": file})[0] == "long.A.b: 61 lines, more than 60"
    file.write_text("\n".join(lines[:-1]))
    assert not any(line.startswith("long.A.b") for line in rules.long_functions({"long": file}))


def test_what_a_module_keeps_to_itself_is_imported_nowhere_else(tmp_path: Path) -> None:
    file = tmp_path / "user.py"
    file.write_text(
        "from __future__ import annotations\nfrom typing import _alias\n"
        "from companion.cli import __main__, app\nimport companion.link._wire as wire\n"
        "def late():\n    from missions.plan import _legs\n"
    )
    assert rules.private_imports({"user": file}) == [
        "user: imports companion.link._wire, which is private",
        "user: imports missions.plan._legs, which is private",
    ]
    assert rules.private_imports(rules.modules()) == []

"""What `make test-gpio` says where it can have no kernel with gpio-sim."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
CANNOT = 77


def kernel(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [FOLDER / "kernel.sh"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_a_kernel_that_is_named_is_taken(tmp_path: Path) -> None:
    program = tmp_path / "linux"
    program.touch(0o700)
    found = kernel(PATH=os.environ["PATH"], HOME=str(tmp_path), VRSPRAY_UML=str(program))
    assert (found.returncode, found.stdout.strip()) == (0, str(program))


def test_one_that_is_not_there_is_a_reason(tmp_path: Path) -> None:
    found = kernel(PATH=os.environ["PATH"], HOME=str(tmp_path), VRSPRAY_UML=str(tmp_path / "no"))
    assert (found.returncode, found.stdout) == (CANNOT, "")
    assert "VRSPRAY_UML names no program" in found.stderr


def test_a_missing_tool_is_a_reason_with_the_way_out(tmp_path: Path) -> None:
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("dirname", "readlink", "cat", "cksum", "cut", "uname"):
        found = shutil.which(name)
        if found is None:
            pytest.skip(f"no {name}")
        (tools / name).symlink_to(found)
    refused = kernel(PATH=str(tools), HOME=str(tmp_path))
    assert refused.returncode == CANNOT
    assert "missing: apt-get install" in refused.stderr or "x86 only" in refused.stderr
    assert not (tmp_path / ".cache").exists()


def test_the_configuration_names_each_option_once() -> None:
    lines = (FOLDER / "kernel.config").read_text().splitlines()
    options = [line for line in lines if line and not line.startswith("#")]
    assert len(set(options)) == len(options)
    assert {"CONFIG_GPIO_SIM=y", "CONFIG_RANDOM_TRUST_BOOTLOADER=y"} <= set(options)
    assert all(line.startswith("CONFIG_") and line.endswith("=y") for line in options)

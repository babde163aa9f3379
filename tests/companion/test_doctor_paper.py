"""The doctor's checks of configuration and map, and the command itself without a vehicle."""

from __future__ import annotations

import json
import re
import shutil
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from companion.cli.doctor import (
    _in_order,
    _summary,
    configuration_checks,
    map_checks,
    refused_configuration,
)
from companion.config import load
from companion.doctor.check import Check, Status, fail, not_applicable, ok, warn
from companion.errors import ConfigError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
TODAY = date(2026, 6, 1)
Captured = pytest.CaptureFixture[str]

pytestmark = pytest.mark.usefixtures("compiles_here")


def paper(*overrides: str, file: Path = EXAMPLE / "config.toml") -> dict[str, Check]:
    config = load(file, overrides=overrides)
    return {check.name: check for check in configuration_checks(config, today=TODAY)}


def of_map(*overrides: str) -> dict[str, Check]:
    config = load(EXAMPLE / "config.toml", overrides=overrides)
    checks, _ = map_checks(config, overrides, now=datetime.now(tz=UTC))
    return {check.name: check for check in checks}


@pytest.mark.parametrize(
    ("overrides", "name", "status"),
    [
        ((), "configuration", Status.OK),
        (("mission.swath_width_m=7.0",), "configuration", Status.FAIL),
        (("flow_trim.enabled=true",), "configuration", Status.WARN),
        ((), "output", Status.OK),
        (("output.kind=none",), "output", Status.WARN),
        ((), "pump-cutoff", Status.WARN),
        (("safety.pump_cutoff=true",), "pump-cutoff", Status.OK),
        (("output.kind=none",), "pump-cutoff", Status.NOT_APPLICABLE),
        ((), "lags", Status.WARN),
        (("lag.on_s=0.11",), "lags", Status.OK),
        ((), "calibration-age", Status.WARN),
        (('lag.measured_on="2026-05-01"',), "calibration-age", Status.OK),
        (('lag.measured_on="2025-12-03"',), "calibration-age", Status.OK),
        (('lag.measured_on="2025-12-02"',), "calibration-age", Status.WARN),
        (('lag.measured_on="2026-06-02"',), "calibration-age", Status.WARN),
        (('lag.measured_on="2026-02-31"',), "calibration-age", Status.WARN),
        ((), "signing-key", Status.NOT_APPLICABLE),
        (("link.signing_key_file=none.key",), "signing-key", Status.FAIL),
    ],
)
def test_the_configuration(overrides: tuple[str, ...], name: str, status: Status) -> None:
    assert paper(*overrides)[name].status is status


def test_a_position_whose_age_was_never_measured_is_told(tmp_path: Path) -> None:
    text = (EXAMPLE / "config.toml").read_text().replace("position_s = 0.0349\n", "")
    file = tmp_path / "config.toml"
    file.write_text(text)
    found = paper("lag.on_s=0.11", file=file)["lags"]
    assert found.status is Status.WARN
    assert "lag.position_s" in found.text


def test_the_text_of_a_wrong_day_is_refused_by_the_configuration() -> None:
    with pytest.raises(ConfigError, match="measured_on"):
        paper('lag.measured_on="last week"')


@pytest.mark.parametrize(
    ("overrides", "statuses"),
    [
        ((), (Status.OK, Status.OK)),
        (("mission.speed_m_s=12.0",), (Status.OK, Status.WARN)),
        (("prescription.file=none.shp",), (Status.FAIL, Status.NOT_APPLICABLE)),
        (("product.rate_max_l_ha=10",), (Status.FAIL, Status.NOT_APPLICABLE)),
    ],
)
def test_the_map(overrides: tuple[str, ...], statuses: tuple[Status, Status]) -> None:
    found = of_map(*overrides)
    assert (found["map"].status, found["rates"].status) == statuses


def test_the_flight_map_is_named_with_its_age_and_what_was_found() -> None:
    found = of_map()["flight-map"]
    assert found.status is Status.WARN
    assert "of prescription.shp, compiled 0 days ago; 1 finding, the first: 120.0 m2" in found.text


def test_the_map_has_the_hash_that_map_check_tells(capsys: Captured) -> None:
    assert execute(["map", "check", str(EXAMPLE / "prescription.shp")]) == 0
    (told,) = re.findall("EPSG:4326, hash ([0-9a-f]{8})\n", capsys.readouterr().out)
    assert of_map(f"prescription.sha256={told}")["map"].text.endswith(f", hash {told}")
    assert of_map("prescription.sha256=01234567")["map"].status is Status.FAIL


def test_a_refused_configuration_says_what_to_write() -> None:
    found = refused_configuration(ConfigError("a.toml: lag.on_s = 99: out of range; write less"))
    assert (found.status, found.fix) == (Status.FAIL, "write less")
    assert refused_configuration(ConfigError("no advice")).fix


# -------------------------------------------------------------------------------- the command


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the example's configuration where the doctor may write, without any systemd."""
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "xdg"))
    folder = tmp_path / "anyang"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("flights", "state"))
    return folder / "config.toml"


def doctor(capsys: Captured, file: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = execute(["doctor", "--config", str(file), "--json", *more])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return code, found


def test_all_checks_are_made_once_and_have_the_keys_of_the_contract(
    config: Path, capsys: Captured
) -> None:
    code, found = doctor(capsys, config, "--no-link")
    assert (code, found["ok"]) == (0, True)
    names = [check["name"] for check in found["checks"]]
    assert len(names) == len(set(names)) > 35
    for check in found["checks"]:
        assert set(check) == {"name", "status", "text", "fix"}
        assert check["status"] in {"ok", "warn", "fail", "not-applicable"}
        assert bool(check["fix"]) == (check["status"] in {"warn", "fail"})
    assert not (config.parent / "flights").exists()


def test_every_check_is_documented(config: Path, capsys: Captured) -> None:
    _, found = doctor(capsys, config, "--no-link")
    page = (EXAMPLE.parents[1] / "docs" / "reference" / "checks.md").read_text()
    assert [check["name"] for check in found["checks"] if f"`{check['name']}`" not in page] == []


def test_a_check_that_fails_is_exit_1(config: Path, capsys: Captured) -> None:
    code, found = doctor(capsys, config, "--no-link", "--set", "prescription.file=none.shp")
    assert (code, found["ok"]) == (1, False)


def test_a_refused_configuration_is_exit_2_and_the_computer_is_checked_still(
    config: Path, capsys: Captured
) -> None:
    code, found = doctor(capsys, config, "--no-link", "--set", "lag.on_s=99")
    assert (code, found["ok"]) == (2, False)
    assert found["checks"][0]["name"] == "configuration"
    assert "system" in {check["name"] for check in found["checks"]}


def test_a_person_reads_one_line_a_check_and_the_verdict(config: Path, capsys: Captured) -> None:
    assert execute(["doctor", "--config", str(config), "--no-link"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("ok    configuration: ")
    assert lines[-1].startswith("nothing failed, no vehicle asked: ")


def test_failures_come_last_and_ready_needs_a_vehicle() -> None:
    found = [fail("map", "none", "write one"), ok("link", "up"), warn("clock", "off", "wait")]
    assert [line.split()[0].rpartition("m")[2] for line in _in_order(found)] == [
        "ok",
        "warn",
        "fail",
    ]
    assert _summary(found).startswith("not ready: ")
    assert _summary(found[1:]).startswith("ready: ")
    assert _summary([not_applicable("link", "skipped")]).startswith("nothing failed, no vehicle")
    assert _summary([ok("click-1", "clicked")]).startswith("passed: ")


def test_the_unit_of_this_configuration_is_recognised(config: Path, capsys: Captured) -> None:
    execute(["service", "install", "--user", "--config", str(config), "--json"])
    capsys.readouterr()
    for file, fix in (
        (config, "try again on a computer where systemd runs"),
        (config.with_name("b.toml"), ""),
    ):
        if not file.exists():
            shutil.copy(config, file)
        _, found = doctor(capsys, file, "--no-link")
        checks = {check["name"]: check for check in found["checks"]}
        assert checks["service-watchdog"]["status"] == "ok"
        assert checks["service"]["fix"] == (fix or f"vrspray service install --config {file}")


def test_a_register_that_is_not_there_fails(config: Path, capsys: Captured) -> None:
    more = ("--set", "output.kind=gpio", "--set", "gpio.driver=spi595")
    _, found = doctor(capsys, config, "--no-link", *more, "--set", "gpio.spi_device=/dev/none")
    checks = {check["name"]: check["status"] for check in found["checks"]}
    assert checks["gpio-chip"] == "fail"
    assert checks["watchdog-script"] == "not-applicable"


def test_a_key_that_cannot_be_read_leaves_no_check_out(config: Path, capsys: Captured) -> None:
    _, without = doctor(capsys, config, "--no-link")
    code, found = doctor(capsys, config, "--set", "link.signing_key_file=none.key")
    assert code == 1
    names = [check["name"] for check in found["checks"]]
    assert names == [check["name"] for check in without["checks"]]


def test_a_serial_link_is_looked_at(config: Path, capsys: Captured) -> None:
    given = ("--set", "link.url=serial:/dev/none:57600")
    _, found = doctor(capsys, config, "--no-link", *given)
    checks = {check["name"]: check for check in found["checks"]}
    assert checks["serial-port"]["text"] == "/dev/none does not exist"

"""The doctor's checks of this computer: facts in, one verdict each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from companion.doctor.check import Check, Status, is_ready, warn
from companion.doctor.computer import (
    Computer,
    Folder,
    HardwareWatchdog,
    Service,
    computer_checks,
    read_computer,
    service_checks,
    try_folder,
)

GOOD = Computer(
    python=(3, 11, 7),
    system="Linux",
    machine="aarch64",
    sqlite=(3, 40, 1),
    folders=(Folder(name="journal-folder", path="flights", free_bytes=10**10, sync_s=0.01),),
    is_clock_synchronised=True,
    may_fifo=True,
    may_lock_memory=True,
    governors=("performance",),
    throttled=0,
    watchdog=HardwareWatchdog(identity="Broadcom BCM2835", timeout_s=15, is_active=True),
)


def by_name(found: Computer, *, needs_engine: bool = True) -> dict[str, Check]:
    return {check.name: check for check in computer_checks(found, needs_engine=needs_engine)}


def test_a_good_computer_has_nothing_to_be_seen_to() -> None:
    assert {check.status for check in by_name(GOOD).values()} == {Status.OK}


def of_folder(**facts: object) -> Computer:
    folder = replace(GOOD.folders[0], **facts)  # type: ignore[arg-type]
    return replace(GOOD, folders=(folder,))


@pytest.mark.parametrize(
    ("found", "name", "status"),
    [
        (replace(GOOD, python=(3, 10, 9)), "system", Status.FAIL),
        (replace(GOOD, system="Darwin"), "system", Status.WARN),
        (replace(GOOD, is_64_bit=False), "system", Status.WARN),
        (replace(GOOD, sqlite=(3, 21, 0)), "sqlite", Status.FAIL),
        (of_folder(problem="read-only"), "journal-folder", Status.FAIL),
        (of_folder(free_bytes=None), "journal-folder", Status.FAIL),
        (of_folder(free_bytes=99_000_000), "journal-folder", Status.FAIL),
        (of_folder(free_bytes=900_000_000), "journal-folder", Status.WARN),
        (of_folder(sync_s=2.0), "journal-folder", Status.WARN),
        (of_folder(sync_s=float("nan")), "journal-folder", Status.WARN),
        (replace(GOOD, is_clock_synchronised=False), "clock", Status.WARN),
        (replace(GOOD, is_clock_synchronised=None), "clock", Status.NOT_APPLICABLE),
        (replace(GOOD, may_fifo=False), "real-time", Status.WARN),
        (replace(GOOD, may_fifo=None), "real-time", Status.WARN),
        (replace(GOOD, may_lock_memory=False), "memory-lock", Status.WARN),
        (replace(GOOD, governors=("ondemand",)), "cpu-governor", Status.WARN),
        (replace(GOOD, governors=("ondemand", "performance")), "cpu-governor", Status.WARN),
        (replace(GOOD, governors=()), "cpu-governor", Status.NOT_APPLICABLE),
        (replace(GOOD, throttled=0x50005), "throttling", Status.FAIL),
        (replace(GOOD, throttled=0x50000), "throttling", Status.WARN),
        (replace(GOOD, throttled=None), "throttling", Status.NOT_APPLICABLE),
        (replace(GOOD, watchdog=None), "hardware-watchdog", Status.NOT_APPLICABLE),
        (
            replace(GOOD, watchdog=HardwareWatchdog(identity="iTCO", timeout_s=60, is_active=True)),
            "hardware-watchdog",
            Status.OK,
        ),
        (
            replace(
                GOOD, watchdog=HardwareWatchdog(identity="bcm2835", timeout_s=60, is_active=True)
            ),
            "hardware-watchdog",
            Status.WARN,
        ),
        (
            replace(GOOD, watchdog=HardwareWatchdog(identity="x", timeout_s=9, is_active=None)),
            "hardware-watchdog",
            Status.WARN,
        ),
    ],
)
def test_each_fact_has_its_verdict(found: Computer, name: str, status: Status) -> None:
    checks = by_name(found)
    assert checks[name].status is status
    others = {check.status for other, check in checks.items() if other != name}
    assert others == {Status.OK}


def test_under_voltage_is_named() -> None:
    assert by_name(replace(GOOD, throttled=1))["throttling"].text == "now: under-voltage"


def test_without_an_engine_real_time_is_not_applicable() -> None:
    checks = by_name(replace(GOOD, may_fifo=False, may_lock_memory=False), needs_engine=False)
    assert checks["real-time"].status is Status.NOT_APPLICABLE
    assert checks["memory-lock"].status is Status.NOT_APPLICABLE


# ------------------------------------------------------------------------------------ the facts


def write(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_the_facts_are_read_from_sys(tmp_path: Path) -> None:
    for cpu in (0, 1):
        write(tmp_path, f"sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "ondemand\n")
    write(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    write(tmp_path, "sys/class/watchdog/watchdog0/identity", "Broadcom BCM2835 Watchdog timer\n")
    write(tmp_path, "sys/class/watchdog/watchdog0/timeout", "15\n")
    write(tmp_path, "sys/class/watchdog/watchdog0/state", "inactive\n")
    found = read_computer({}, root=tmp_path)
    assert found.governors == ("ondemand",)
    assert found.throttled == 0x50005
    assert found.watchdog == HardwareWatchdog(
        identity="Broadcom BCM2835 Watchdog timer", timeout_s=15, is_active=False
    )


def test_a_computer_that_shows_nothing_is_read_too(tmp_path: Path) -> None:
    write(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "no number")
    found = read_computer({"journal-folder": tmp_path / "new" / "flights"}, root=tmp_path)
    assert (found.governors, found.throttled, found.watchdog) == ((), None, None)
    assert found.folders[0].problem is None
    assert not (tmp_path / "new").exists()
    assert list(tmp_path.glob(".vrspray-*")) == []


def test_a_folder_that_is_a_file_says_so(tmp_path: Path) -> None:
    (tmp_path / "flights").touch()
    found = try_folder("journal-folder", tmp_path / "flights")
    assert found.problem is not None
    assert str(tmp_path / "flights") in found.problem


# ---------------------------------------------------------------------------------- the service

INSTALLED = Service(
    is_installed=True,
    is_user=False,
    is_watched=True,
    config="field.toml",
    uses_config=True,
    state={"UnitFileState": "enabled", "ActiveState": "inactive"},
)


@pytest.mark.parametrize(
    ("found", "service", "watchdog"),
    [
        (INSTALLED, Status.OK, Status.OK),
        (replace(INSTALLED, is_watched=False), Status.OK, Status.WARN),
        (replace(INSTALLED, uses_config=False), Status.WARN, Status.OK),
        (replace(INSTALLED, state=None), Status.WARN, Status.OK),
        (replace(INSTALLED, state={}), Status.WARN, Status.OK),
        (replace(INSTALLED, state={"UnitFileState": "disabled"}), Status.WARN, Status.OK),
        (
            replace(INSTALLED, state={"UnitFileState": "enabled", "ActiveState": "failed"}),
            Status.WARN,
            Status.OK,
        ),
        (
            replace(INSTALLED, state={"UnitFileState": "enabled", "ActiveState": "active"}),
            Status.WARN,
            Status.OK,
        ),
        (replace(INSTALLED, is_installed=False), Status.WARN, Status.NOT_APPLICABLE),
        (
            replace(INSTALLED, is_installed=False, state=None),
            Status.NOT_APPLICABLE,
            Status.NOT_APPLICABLE,
        ),
    ],
)
def test_the_service(found: Service, service: Status, watchdog: Status) -> None:
    checks = {check.name: check.status for check in service_checks(found)}
    assert checks == {"service": service, "service-watchdog": watchdog}


# ------------------------------------------------------------------------------------- a check


def test_what_is_not_in_order_needs_its_fix() -> None:
    with pytest.raises(ValueError, match="without a fix"):
        Check(name="clock", status=Status.FAIL, text="wrong")
    with pytest.raises(ValueError, match="one line"):
        Check(name="clock", status=Status.OK, text="two\nlines")


def test_only_a_failure_keeps_on_the_ground() -> None:
    assert is_ready([warn("clock", "not synchronised", "wait")])
    assert not is_ready([Check(name="map", status=Status.FAIL, text="none", fix="write one")])

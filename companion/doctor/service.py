"""Is the service installed, started with the computer, and watched: facts in, checks out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from companion.doctor.check import Check, not_applicable, ok, warn


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """The unit as it was found; `state` is None where there is no systemd to ask."""

    is_installed: bool
    is_user: bool
    is_watched: bool
    config: str
    uses_config: bool
    state: Mapping[str, str] | None


def service_checks(found: Service) -> Iterator[Check]:
    """Yield the checks of the service and of its watchdog."""
    rest = ("service-watchdog",)
    if found.state is None and not found.is_installed:
        why = "there is no systemd on this computer"
        yield from (not_applicable(name, why) for name in ("service", *rest))
        return
    if not found.is_installed:
        yield warn(
            "service",
            "not installed: nothing starts or watches the companion",
            f"sudo vrspray service install --config {found.config}",
        )
        yield from (not_applicable(name, "the service is not installed") for name in rest)
        return
    yield _enabled(found)
    if not found.is_watched:
        fix = "vrspray service install writes it anew"
        yield warn("service-watchdog", "the unit has no WatchdogSec", fix)
    else:
        yield ok("service-watchdog", "fed by the control loop")


def _enabled(found: Service) -> Check:
    call = "systemctl --user" if found.is_user else "sudo systemctl"
    if not found.uses_config:
        fix = f"vrspray service install --config {found.config}"
        return warn("service", "it uses another configuration than this one", fix)
    if found.state is None:
        fix = "ask again where systemd runs"
        return warn("service", "installed; systemd does not answer", fix)
    if not found.state.get("UnitFileState", "").startswith("enabled"):
        fix = f"{call} enable vrspray"
        return warn("service", "installed, and not started with the computer", fix)
    active = found.state.get("ActiveState", "unknown")
    if active == "failed":
        result = found.state.get("Result", "unknown")
        return warn("service", f"its last run failed ({result})", "see journalctl -u vrspray")
    if active == "active":
        fix = f"{call} stop vrspray, to have link and lines checked"
        return warn("service", "it runs now, and has the link and the lines", fix)
    return ok("service", f"installed and enabled, {active} now")

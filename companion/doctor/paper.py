"""What can be checked at a desk: configuration, map, what was measured, what was declared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date, datetime

from companion.assembly import build_setup, deliverable
from companion.config import Config
from companion.config.rules import mismatches, without_effect
from companion.core.setup import Setup
from companion.doctor.check import Check, fail, not_applicable, ok, split_advice, warn
from companion.errors import ConfigError, LinkError, MapError
from companion.flight_map import FlightMap, flight_map_of
from companion.link.signing import read_key
from companion.wording import counted

# Nozzles wear, hoses age, pumps lose pressure: half a year is about one season of spraying.
CALIBRATION_MAX_DAYS = 180
# Lags of docs and examples, measured on simulated sprayers: on, off, up, down.
_EXAMPLE_LAGS = frozenset({(0.10, 0.08, 0.10, 0.10), (0.1028, 0.1059, 0.1033, 0.1030)})


def configuration_checks(config: Config, *, today: date) -> Iterator[Check]:
    """Yield what the configuration alone tells; it has been read, so it is valid by itself."""
    yield _agreement(config)
    yield _output(config)
    yield _dead_man(config)
    yield _lags(config)
    yield _age(config.lag.measured_on, today)
    yield _signing(config)


def refused_configuration(error: ConfigError) -> Check:
    """Return the check of a configuration that cannot be used; its error says what to write."""
    return fail("configuration", *split_advice(str(error), "see vrspray config check FILE"))


def _agreement(config: Config) -> Check:
    name = "configuration"
    wrong = [*mismatches(config)]
    if wrong:
        return fail(name, f"{wrong[0].key}: {wrong[0].text}", "correct it in the file")
    idle = [*without_effect(config)]
    if idle:
        keys = ", ".join(found.key for found in idle)
        return warn(name, f"without effect in this version: {keys}", "leave the keys out")
    return ok(name, f"{config.path} is valid")


def _output(config: Config) -> Check:
    kind = config.output.kind
    if kind == "none":
        return warn("output", "a dry run: no valve opens", 'write output.kind = "servo" or "gpio"')
    what = "servo outputs" if kind == "servo" else f"GPIO lines of {config.output.chip}"
    channels = ", ".join(str(valve.channel) for valve in config.valve)
    return ok("output", f"{len(config.valve)} valves on {what} {channels}")


def _dead_man(config: Config) -> Check:
    name = "pump-cutoff"
    if config.output.kind == "none":
        return not_applicable(name, "a dry run")
    if config.safety.pump_cutoff:
        return ok(name, "declared: a relay cuts the pump when this computer fails; try it")
    return warn(
        name,
        "none declared: a valve that sticks, or a computer that stands still, sprays on",
        "fit a relay that cuts the pump and write safety.pump_cutoff = true",
    )


def _lags(config: Config) -> Check:
    lag = config.lag
    if (lag.on_s, lag.off_s, lag.up_s, lag.down_s) in _EXAMPLE_LAGS:
        return warn(
            "lags",
            "those of an example, measured on a simulated sprayer",
            "measure yours: vrspray calibrate lag",
        )
    if config.settings()["lag.position_s"][1] == "default":
        return warn(
            "lags",
            "lag.position_s is not set: 0 s is taken for the age of a position",
            "measure it: vrspray calibrate lag-marks, then write it",
        )
    return ok("lags", f"on {lag.on_s:g}, off {lag.off_s:g}, position {lag.position_s:g} s")


def _age(measured_on: str | None, today: date) -> Check:
    name = "calibration-age"
    if measured_on is None:
        return warn(
            name,
            "lag.measured_on is not set: nothing says when flows and lags were measured",
            'write the day, such as measured_on = "2026-05-01", under [lag]',
        )
    fix = "correct lag.measured_on, or the clock of this computer"
    try:
        days = (today - date.fromisoformat(measured_on)).days
    except ValueError:
        return warn(name, f"{measured_on} is no day", fix)
    if not days >= 0:
        return warn(name, f"measured on {measured_on}, which is to come", fix)
    if not days <= CALIBRATION_MAX_DAYS:
        fix = "measure again: vrspray calibrate flow, vrspray calibrate lag"
        return warn(name, f"measured {days} days ago", fix)
    return ok(name, f"measured {days} days ago")


def _signing(config: Config) -> Check:
    name, file = "signing-key", config.link.signing_key_file
    if file is None:
        return not_applicable(name, "messages are not signed")
    try:
        read_key(config.resolve(file))
    except LinkError as error:
        return fail(name, *split_advice(str(error), "give the path of the key"))
    return ok(name, "readable by its owner only")


def map_checks(
    config: Config, overrides: Sequence[str] = (), *, now: datetime
) -> tuple[list[Check], Setup | None]:
    """Return whether map and boundary can be flown, and what was built of them."""
    try:
        flight_map = flight_map_of(config, overrides)
        setup = build_setup(config, flight_map)
    except MapError as error:
        fix = error.fix or "see vrspray map check FILE"
        return [fail("map", str(error).removesuffix(f"; {error.fix}"), fix), *_no_map()], None
    except ConfigError as error:
        advice = split_advice(str(error), "see vrspray config check FILE")
        return [fail("map", *advice), *_no_map()], None
    rates = setup.prescription.rates_l_ha
    area_ha = setup.prescription.field.area / 1e4
    span = f"{min(rates):g} to {max(rates):g} L/ha" if rates else "no rates"
    found = [
        ok("map", f"{area_ha:.2f} ha, {span}"),
        _flight_map(flight_map, now),
        _rates(config, setup),
    ]
    return found, setup


def _no_map() -> list[Check]:
    return [not_applicable(name, "there is no map") for name in ("flight-map", "rates")]


def _flight_map(flight_map: FlightMap, now: datetime) -> Check:
    """Say which flight map this is, how old it is, and what was found when it was compiled."""
    name = "flight-map"
    days = flight_map.age_days(now)
    age = "on an unknown day" if days is None else f"{counted(int(days), 'day')} ago"
    text = f"{flight_map.sha256[:8]} of {flight_map.source}, compiled {age}"
    if not flight_map.findings:
        return ok(name, f"{text}; nothing found wrong with the map")
    first = flight_map.findings[0]
    return warn(
        name,
        f"{text}; {counted(len(flight_map.findings), 'finding')}, the first: {first.text}",
        first.fix or "see vrspray map check FILE",
    )


def _rates(config: Config, setup: Setup) -> Check:
    """Check the prescribed rates against what the nozzle sets deliver at the planned speed."""
    if config.mission is None:
        return not_applicable("rates", "no mission.speed_m_s to compare the rates with")
    speed_m_s = config.mission.speed_m_s
    problems = deliverable(setup, speed_m_s)
    if problems:
        return warn("rates", problems[0].text, problems[0].fix)
    return ok("rates", f"the nozzle sets deliver all of them at {speed_m_s:g} m/s")

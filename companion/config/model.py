"""The configuration as a whole: read from its file, or one line why not; in the core's types."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from datetime import date, time
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from companion.config.application_table import told
from companion.config.document import Document, Origin, leaves
from companion.config.rules import contradictions
from companion.config.tables import contradiction
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.options.drift import Drift, blowing, fall_s
from companion.core.safety import Limits
from companion.core.schedule import LagModel
from companion.core.types import Fix, Method, PwmLimits
from companion.errors import ConfigError
from companion.wording import read_toml, show_value

# ---------------------------------------------------------------------------------------- the whole

FIXES = {
    "3d": Fix.FIX_3D,
    "dgps": Fix.DGPS,
    "rtk-float": Fix.RTK_FLOAT,
    "rtk-fixed": Fix.RTK_FIXED,
}
# Ten times what an RTK receiver says of itself when all is well.
RTK_ACCURACY_MAX_M = 0.3
# A plan's lines overlap where the field is not a whole number of swaths wide: closed where all of a
# strip is treated, a valve leaves no bare ground there.
ON_LINES_PERCENT = 100.0


class Config(Document):
    """A file that makes sense; conversions to types of the core happen here and nowhere else."""

    @model_validator(mode="after")
    def _agree(self) -> Self:
        found = [*contradictions(self)]
        if found:
            raise contradiction(*found)
        return self

    def nozzle_sets(self) -> tuple[NozzleSet, ...]:
        """Return the sets, from the smallest to the largest flow."""
        if self.pump is not None and self.makes_flow:
            from companion.config.motor_rules import pump_set

            return (pump_set(self, self.pump),)
        index = {valve.name: number for number, valve in enumerate(self.valve)}
        factors = [valve.flow_factor for valve in self.valve]
        sets = []
        for table in self.nozzle_set:
            duty, flow_l_min = table.points(self.valve)
            sets.append(
                NozzleSet.with_factors(
                    tuple(sorted(index[name] for name in table.valves)),
                    FlowCurve(duty=duty, flow_l_min=flow_l_min),
                    factors,
                )
            )
        return tuple(sorted(sets, key=lambda nozzles: nozzles.flow_max_l_min))

    def pwm_limits(self) -> PwmLimits:
        """Return what the valves can follow, or the pump that makes their flow."""
        if self.pump is not None and self.makes_flow:
            from companion.config.motor_rules import fraction_min

            return PwmLimits(
                frequency_hz=self.pwm.frequency_hz,
                duty_min=fraction_min(self.pump),
                duty_max=1.0,
                min_on_s=0.0,
                min_off_s=0.0,
            )
        return PwmLimits(
            frequency_hz=self.pwm.frequency_hz,
            duty_min=self.pwm.duty_min,
            duty_max=self.pwm.duty_max,
            min_on_s=self.pwm.min_on_s,
            min_off_s=self.pwm.min_off_s,
        )

    def lag_model(self) -> LagModel:
        """Return the identified lags."""
        lag = self.lag
        return LagModel(
            on_s=lag.on_s,
            off_s=lag.off_s,
            up_s=lag.up_s,
            down_s=lag.down_s,
            on_start_s=lag.on_start_s,
            off_end_s=lag.off_end_s,
            output_s=lag.output_s,
            position_s=lag.position_s,
            reference=lag.reference,
            up_time_s=lag.up_time_s,
            down_time_s=lag.down_time_s,
        )

    def method(self) -> Method:
        """Return how changes of rate are placed."""
        return Method(self.lag.method)

    def look_ahead_s(self) -> float:
        """Return T = T1 + T2 + T3 of Wang et al. 2024, for the method `look-ahead`."""
        return sum(self.lag.look_ahead_s)

    def limits(self) -> Limits:
        """Return what must hold before a valve may open."""
        safety = self.safety
        return Limits(
            modes=frozenset(mode.upper() for mode in safety.modes),
            position_age_max_s=safety.position_age_max_s,
            heartbeat_age_max_s=safety.heartbeat_age_max_s,
            speed_min_m_s=safety.speed_min_m_s,
            speed_max_m_s=safety.speed_max_m_s,
            speed_disagreement_max_m_s=safety.speed_disagreement_max_m_s,
            height_min_m=safety.height_min_m,
            height_max_m=safety.height_max_m,
            fix=FIXES[safety.fix],
            wind_max_m_s=safety.wind_max_m_s,
            wind_required=safety.wind_required,
            wind_age_max_s=safety.wind_age_max_s,
            speed_check_required=safety.speed_check_required,
            enable_by=frozenset(safety.enable_by),
            rc_channel=safety.rc_channel,
            accuracy_max_m=self._accuracy_max_m(),
            estop_required=safety.estop_line is not None,
            label=None if self.label is None else self.label.flown(self.told()),
        )

    def _accuracy_max_m(self) -> float | None:
        """Return the limit on what the receiver says of itself; by default only of an RTK fix."""
        safety = self.safety
        if safety.accuracy_max_m is None and FIXES[safety.fix] >= Fix.RTK_FLOAT:
            return RTK_ACCURACY_MAX_M
        return safety.accuracy_max_m

    def switch_off_percent(self, *, on_lines: bool) -> float | None:
        """Return from how much treated ground on a valve closes; None where it never does.

        `on_lines` is whether only the lines of a plan are sprayed.
        """
        percent = self.coverage.switch_off_percent
        if percent is None:
            return ON_LINES_PERCENT if on_lines else None
        return None if percent == "never" else percent

    def told(self) -> dict[str, Any]:
        """Return what the operator says for the record, by dotted key, and what the map implies."""
        found = told(self.application, self.product)
        if self.prescription is not None and self.prescription.mix_rate is not None:
            found.setdefault("application.product_per_l", 1.0 / self.prescription.mix_rate)
            found.setdefault("application.product_unit", "L")
        return found

    def rate_max_l_ha(self) -> float | None:
        """Return the most that product and label allow; None where neither says."""
        label = None if self.label is None else self.label.rate_max_l_ha
        said = [each for each in (self.product.rate_max_l_ha, label) if each is not None]
        return min(said, default=None)

    def drift_law(self) -> Drift | None:
        """Return where droplets are expected to land; None unless it is to be corrected for."""
        drift = self.drift
        if not drift.enabled:
            return None
        falling_s = drift.fall_s
        if falling_s is None:
            falling_s = fall_s(
                drift.droplet_um, self.boom_table.height_m, downwash_m_s=drift.downwash_m_s
            )
        return Drift(
            fall_s=falling_s,
            forward_carry_m=drift.forward_carry_m,
            limit_m=drift.limit_m,
            wind_max_m_s=self.safety.wind_max_m_s,
            wind_age_max_s=drift.wind_age_max_s,
            wind_m_s=None if drift.wind is None else blowing(*drift.wind),
        )


# --------------------------------------------------------------------------------- read from a file

STEP = re.compile(r"([A-Za-z0-9_-]+)((?:\[\d+\])*)")


def load(path: Path, *, overrides: Sequence[str] = ()) -> Config:
    """Return the configuration in `path`, with `overrides` such as "lag.on_s=0.12" on top.

    Raises:
        ConfigError: in one line: file, key, value, what to write instead.
    """
    text, raw = read_toml(path, what="a configuration")
    origins: dict[str, Origin] = {key: "file" for key, _ in leaves(raw)}
    for override in overrides:
        origins.update((key, "override") for key in _apply(raw, override))
    for key, value in leaves(raw):
        texts = value if isinstance(value, list) else [value]
        if any(isinstance(text, str) and "\0" in text for text in texts):
            raise ConfigError(
                f"{path}: {key} = {show_value(value)}: a NUL character; write the text without it"
            )
    config = Config.checked(raw, path)
    name, label = config.limits_table.file, None
    if name is not None:
        from companion.config.limits import read_limits

        label = read_limits(path.parent / name, f"{path}: limits.file: {path.parent / name}")
    return config.came_from(path, source_text=text, origins=origins, label=label)


def _apply(raw: dict[str, Any], override: str) -> list[str]:
    """Set what `override` says in `raw` and return the keys that it set."""
    key, equals, value_text = override.partition("=")
    key = key.strip()
    steps = _steps(key)
    if not equals or not steps:
        raise ConfigError(
            f"override {show_value(override)}: no setting; write KEY=VALUE such as lag.on_s=0.12"
        )
    value = parse_value(value_text.strip())
    node: Any = raw
    for step, following in zip(steps, [*steps[1:], None], strict=True):
        if isinstance(step, int) and not (isinstance(node, list) and step < len(node)):
            raise ConfigError(f"override {key}: there is no entry [{step}]; count from 0")
        if isinstance(step, str) and not isinstance(node, dict):
            raise ConfigError(f"override {key}: {step} stands in no table; see `config show`")
        if following is None:
            node[step] = value
        elif isinstance(step, str):
            node = node.setdefault(step, {})
        else:
            node = node[step]
    return [leaf for leaf, _ in leaves(value, key)]


def _steps(key: str) -> list[str | int]:
    """Return the names and indices of a dotted key; nothing when it is none.

    >>> _steps("valve[2].right_m")
    ['valve', 2, 'right_m']
    """
    steps: list[str | int] = []
    for part in key.split("."):
        match = STEP.fullmatch(part)
        if match is None:
            return []
        steps.append(match[1])
        steps.extend(int(index) for index in re.findall(r"\d+", match[2]))
    return steps


def parse_value(text: str) -> Any:
    """Return what follows `--set KEY=` as TOML has it; what it does not know is text, and a time.

    >>> [parse_value(text) for text in ("0.12", "none", '["AUTO"]', "2026-05-01T06:30:00Z")]
    [0.12, 'none', ['AUTO'], '2026-05-01T06:30:00Z']
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    is_value = list(parsed) == ["value"] and not isinstance(parsed["value"], date | time)
    return parsed["value"] if is_value else text

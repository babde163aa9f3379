"""The link of a run: signing, parameters that a station may set, and what of them was kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from companion.cli.answer import note
from companion.config import Config, load
from companion.config.rules import tank_capacity_l
from companion.errors import ConfigError
from companion.link.component import ComponentOptions
from companion.link.parameters import (
    SETTINGS,
    Parameters,
    known_parameters,
    read_state,
    write_state,
)
from companion.link.vehicle_link import VehicleLink

PARAMETERS_NAME = "parameters.json"


def load_with_kept(path: Path, overrides: Sequence[str]) -> tuple[Config, tuple[str, ...]]:
    """Return the configuration with the parameters that a station set, and all overrides.

    What is given on the command line counts more than what was kept.
    """
    config = load(path, overrides=overrides)
    state = _state_file(config)
    kept = _overrides(read_state(state))
    if not kept:
        return config, tuple(overrides)
    given = (*kept, *overrides)
    try:
        config = load(path, overrides=given)
    except ConfigError as error:
        raise ConfigError(
            f"{state}: its values do not go with the configuration any more ({error}); delete it "
            "and set them again"
        ) from error
    note(f"parameters of {state}: {', '.join(kept)}")
    return config, given


def build_link(config: Config, given: Sequence[str], options: ComponentOptions) -> VehicleLink:
    """Return the link that the configuration describes, not yet open."""
    state = _state_file(config)
    in_force = {key: value for key, (value, _) in config.settings().items()}
    settings = {key: float(in_force[key]) for key, _, _ in SETTINGS.values() if key in in_force}
    tank_l = tank_capacity_l(config)

    def save(values: Mapping[str, float]) -> bool:
        return write_state(state, values)

    def check(values: Mapping[str, float]) -> str | None:
        try:
            load(config.path, overrides=(*given, *_overrides(values)))
        except ConfigError:
            return "not with the other settings"
        return None

    parameters = Parameters(
        known_parameters(settings, tank_l=tank_l), kept=read_state(state), save=save, check=check
    )
    signing = None
    if config.link.signing_key_file is not None:
        from companion.link.signing import Signing, read_key

        key = read_key(config.resolve(config.link.signing_key_file))
        signing = Signing(key, state_folder=state.parent)
    return VehicleLink(config.link.url, options, parameters=parameters, signing=signing)


def _state_file(config: Config) -> Path:
    return config.resolve(config.link.state_folder) / PARAMETERS_NAME


def _overrides(values: Mapping[str, float]) -> list[str]:
    return [f"{SETTINGS[name][0]}={value!r}" for name, value in values.items() if name in SETTINGS]

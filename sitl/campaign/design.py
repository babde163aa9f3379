"""The campaign file: which settings are varied, how, and over which seeds; and each flight of it.

A flight has a number. From the number follow its settings and its seed, so that any process can fly
any of them, and nothing has to be kept of those that were not flown yet.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from companion.config import load
from companion.config.tables import Table, Text
from companion.errors import ConfigError
from companion.wording import missing, read_toml
from sitl.anyang import EXAMPLE
from sitl.campaign.settings import (
    NOT_IN_CONDITIONS,
    NOT_OF_FILES,
    NOT_ON_P1S_FIELD,
    P1S_FIELD,
    Settings,
    Value,
    check_name,
    check_value,
    overrides_of,
)

VERSION = 1
DesignKind = Literal["grid", "latin-hypercube", "sobol", "morris"]
GRID: DesignKind = "grid"
HYPERCUBE, SOBOL, MORRIS = "latin-hypercube", "sobol", "morris"
FLIGHTS_MAX = 10_000_000
MORRIS_LEVELS = 4
EXAMPLE_CONFIG = EXAMPLE / "config.toml"
TRIED_MAX = 20


@dataclass(frozen=True, slots=True)
class Factor:
    """A setting that is varied: over values, or between two ends."""

    name: str
    values: tuple[Value, ...] = ()
    low: float = 0.0
    high: float = 0.0

    def at(self, share: float) -> Value:
        """Return the value at a share of the way from the lowest to the highest."""
        if self.values:
            return self.values[min(int(share * len(self.values)), len(self.values) - 1)]
        return self.low + share * (self.high - self.low)

    @property
    def tried(self) -> tuple[Value, ...]:
        """Return what tells whether the setting takes what it will be given."""
        return self.values or (self.low, self.high)


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """A campaign file that was read and checked."""

    path: Path
    text: str
    name: str
    seeds: tuple[int, ...]
    fixed: Mapping[str, Value]
    kind: str
    samples: int
    seed: int
    second_order: bool
    factors: tuple[Factor, ...]
    cases: tuple[tuple[str, Mapping[str, Value]], ...]
    # How many of the seeds were added at a time: numbers of flights that were flown stay theirs.
    blocks: tuple[int, ...] = ()

    @property
    def sha256(self) -> str:
        """Return the hash of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Return a row for each point of the design, a column for each factor: 0 to 1."""
        return _points(self)

    @property
    def settings_count(self) -> int:
        """Return how many settings are flown, each with every seed."""
        return len(self.cases) * len(self.points)

    @property
    def flights(self) -> int:
        """Return how many flights there are."""
        return self.settings_count * len(self.seeds)

    @property
    def varied(self) -> tuple[str, ...]:
        """Return every setting that is not the same in all flights."""
        of_cases = (name for _, case in self.cases for name in case)
        return tuple(dict.fromkeys((*(each.name for each in self.factors), *of_cases)))

    def place(self, number: int) -> tuple[int, int]:
        """Return the number of a flight's settings, and its seed."""
        first = 0
        for count in self.blocks:
            if number < count * self.settings_count:
                break
            number -= count * self.settings_count
            first += count
        else:
            count = len(self.seeds) - first
        point, at = divmod(number, count)
        return point, self.seeds[first + at]

    def flight(self, number: int) -> tuple[str, Settings, int]:
        """Return the case, all settings and the seed of one flight."""
        point, seed = self.place(number)
        case, place = divmod(point, len(self.points))
        name, of_case = self.cases[case]
        varied = {
            factor.name: factor.at(share)
            for factor, share in zip(self.factors, self.points[place].tolist(), strict=True)
        }
        return name, tuple(sorted({**self.fixed, **of_case, **varied}.items())), seed

    def tried(self) -> Iterator[dict[str, Value]]:
        """Yield settings in which every value is tried once, beside the first of all others."""
        first = {factor.name: factor.tried[0] for factor in self.factors}
        for _, case in self.cases:
            yield {**self.fixed, **first, **case}
        for factor in self.factors:
            for value in factor.tried:
                yield {**self.fixed, **first, **self.cases[0][1], factor.name: value}


def _points(campaign: Campaign) -> NDArray[np.float64]:
    factors = campaign.factors
    if not factors:
        return np.zeros((1, 0))
    if campaign.kind == GRID:
        middles = [[(k + 0.5) / len(f.values) for k in range(len(f.values))] for f in factors]
        return np.array(list(itertools.product(*middles)))
    try:
        if campaign.kind == HYPERCUBE:
            from scipy.stats import qmc

            rng = np.random.default_rng(np.random.SeedSequence(campaign.seed))
            drawn = qmc.LatinHypercube(len(factors), rng=rng).random(campaign.samples)
            return np.asarray(drawn, dtype=np.float64)
        return _for_sensitivity(campaign)
    except ImportError as error:
        raise ConfigError(f"{campaign.path}: {missing(str(error.name), 'campaign')}") from error


def problem_of(campaign: Campaign) -> dict[str, Any]:
    """Return the factors as SALib has them."""
    return {
        "num_vars": len(campaign.factors),
        "names": [factor.name for factor in campaign.factors],
        "bounds": [[0.0, 1.0]] * len(campaign.factors),
    }


def _for_sensitivity(campaign: Campaign) -> NDArray[np.float64]:
    from SALib.sample import morris, sobol

    problem = problem_of(campaign)
    if campaign.kind == SOBOL:
        drawn = sobol.sample(
            problem,
            campaign.samples,
            calc_second_order=campaign.second_order,
            seed=campaign.seed,
        )
    else:
        drawn = morris.sample(
            problem, campaign.samples, num_levels=MORRIS_LEVELS, seed=campaign.seed
        )
    return np.asarray(drawn, dtype=np.float64)


# ------------------------------------------------------------------------------------------ reading

Whole = Annotated[int, Field(ge=0)]


class _Seeds(Table):
    first: Whole = 1
    count: int = Field(ge=1, le=FLIGHTS_MAX)


class _Design(Table):
    kind: DesignKind = GRID
    samples: Whole = 0
    seed: Whole = 1
    second_order: bool = False


class _Vary(Table):
    set: Text
    values: list[Any] | None = Field(default=None, min_length=1)
    low: float | None = None
    high: float | None = None
    steps: int | None = Field(default=None, ge=2)


class _File(Table):
    version: int = Field(ge=VERSION, le=VERSION)
    name: Text | None = None
    seeds: Any = 1
    fixed: dict[str, Any] = Field(default={})
    design: _Design = _Design()
    vary: list[_Vary] = Field(default=[])
    case: list[dict[str, Any]] = Field(default=[])


def read_campaign(path: Path, *, checked: bool = True) -> Campaign:
    """Read a campaign file; without `checked` the other files that it names may be gone.

    Raises:
        ConfigError: in one line: file, key, value, what to write instead.
    """
    text, raw = read_toml(path, what="a campaign")
    file = _File.checked(raw, path)
    try:
        found = Campaign(
            path=path,
            text=text,
            name=file.name or path.stem,
            seeds=_seeds(file.seeds),
            fixed=_settings(file.fixed, "fixed"),
            factors=tuple(_factor(each, n) for n, each in enumerate(file.vary)),
            cases=_cases(file.case),
            **file.design.model_dump(),
        )
        _check_design(found)
        _check_settings(found)
        if checked:
            _check_configuration(found)
        return found
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _check_design(found: Campaign) -> None:
    names = [factor.name for factor in found.factors]
    for name in names:
        if names.count(name) > 1 or any(
            name in each for each in (found.fixed, *(case for _, case in found.cases))
        ):
            raise ConfigError(f"vary.set = '{name}': varied twice; keep one of them")
    for factor in found.factors:
        if found.kind == GRID and not factor.values:
            raise ConfigError(
                f"vary.set = '{factor.name}': a grid needs values, or low, high, steps"
            )
    if found.kind != GRID:
        if not found.factors:
            raise ConfigError(
                f"design.kind = '{found.kind}': nothing is varied; add [[vary]] tables"
            )
        if not found.samples >= 2:
            raise ConfigError(f"design.samples = {found.samples}: write 2 or more")
    if found.kind == SOBOL and found.samples & (found.samples - 1):
        near = 1 << round(math.log2(found.samples))
        raise ConfigError(
            f"design.samples = {found.samples}: a sobol design needs a power of two; write {near}"
        )
    per_factor = {GRID: 0, HYPERCUBE: 1, SOBOL: 2 * len(names) + 2, MORRIS: len(names) + 1}
    points = found.samples * per_factor[found.kind] or math.prod(
        len(factor.values) for factor in found.factors
    )
    if not points * len(found.cases) * len(found.seeds) <= FLIGHTS_MAX:
        raise ConfigError(f"more than {FLIGHTS_MAX:,} flights; take fewer values, samples or seeds")


def _check_settings(found: Campaign) -> None:
    """Refuse what no flight can have; what some have is told by their rows."""
    for given in found.tried():
        if ("flight.config" in given) != ("flight.mission" in given):
            missing = "mission" if "flight.config" in given else "config"
            raise ConfigError(
                f"flight.{missing}: missing; give flight.config and flight.mission, or neither of "
                "them for the published field (Wang et al. 2024)"
            )
        if "flight.config" in given:
            for name in NOT_OF_FILES:
                if name in given:
                    raise ConfigError(
                        f"{name}: on the published field only; leave it out, or flight.config"
                    )
        else:
            _refuse_without_effect(given)
        field = given.get("flight.field", P1S_FIELD)
        if field != P1S_FIELD:
            for name in NOT_IN_CONDITIONS:
                if name in given:
                    raise ConfigError(f"{name}: '{field}' has its own; leave it out")
        if "method.controller" in given and {"method.name", "method.look_ahead_s"} & set(given):
            raise ConfigError(
                "method.controller: stands alone; leave out the other method. settings"
            )


def _refuse_without_effect(given: Mapping[str, Value]) -> None:
    for name in given:
        for start, fix in NOT_ON_P1S_FIELD.items():
            if name.startswith(start):
                raise ConfigError(f"{name}: changes nothing over the published field; {fix}")


def _check_configuration(found: Campaign) -> None:
    """Refuse keys that the configuration does not have, and those whose every value it refuses.

    A value that it refuses beside others that it takes costs the flights that have it.
    """
    folder = found.path.resolve().parent
    by_name: dict[str, set[Value]] = {}
    for given in found.tried():
        path = folder / str(given["flight.config"]) if "flight.config" in given else EXAMPLE_CONFIG
        for name, value in given.items():
            if name.startswith("config."):
                by_name.setdefault(name, set()).add(value)
    for name, values in by_name.items():
        refused = []
        for value in sorted(values, key=str)[:TRIED_MAX]:
            try:
                load(path, overrides=overrides_of({name: value}))
                break
            except ConfigError as error:
                refused.append(error)
        else:
            raise ConfigError(f"{name}: the configuration refuses it: {refused[0]}")


def _factor(entry: _Vary, number: int) -> Factor:
    where, name = f"vary[{number}]", entry.set
    check_name(name)
    ends = [end for end in (entry.low, entry.high) if end is not None]
    if len(ends) != (2 if entry.values is None else 0):
        raise ConfigError(f"{where} ({name}): give values, or low and high")
    if entry.values is not None:
        checked = tuple(check_value(name, value) for value in entry.values)
        if len({str(value) for value in checked}) < len(checked):
            raise ConfigError(f"{where}.values: one of them stands there twice")
        return Factor(name, values=checked)
    low, high = ends
    if not low < high:
        raise ConfigError(f"{where}: low = {low:g} must be below high = {high:g}")
    for end in (low, high):
        check_value(name, end)
    if entry.steps is not None:
        # As they are written: 0.12, not 0.12000000000000001.
        evenly = (float(f"{value:.12g}") for value in np.linspace(low, high, entry.steps).tolist())
        return Factor(name, values=tuple(evenly))
    return Factor(name, low=low, high=high)


def _cases(entries: Sequence[Mapping[str, Any]]) -> tuple[tuple[str, Mapping[str, Value]], ...]:
    found: list[tuple[str, Mapping[str, Value]]] = []
    for number, entry in enumerate(entries):
        settings = dict(entry)
        name = settings.pop("name", f"case {number + 1}")
        if not isinstance(name, str) or not name:
            raise ConfigError(f"case[{number}].name = {name!r}: write text")
        if any(name == other for other, _ in found):
            raise ConfigError(f"case[{number}].name = '{name}': another case has this name")
        found.append((name, _settings(settings, f"case[{number}]")))
    return tuple(found) or (("", {}),)


def _settings(table: Mapping[str, Any], where: str) -> dict[str, Value]:
    found = {}
    for name, value in _flat(table):
        try:
            check_name(name)
            found[name] = check_value(name, value)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
    return found


def _flat(table: Mapping[str, Any], start: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the settings of nested tables by their dotted names.

    >>> dict(_flat({"config": {"lag": {"on_s": 0.1}}, "flight.fidelity": "averaged"}))
    {'config.lag.on_s': 0.1, 'flight.fidelity': 'averaged'}
    """
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{start}{key}.")
        else:
            yield f"{start}{key}", value


def _seeds(given: object) -> tuple[int, ...]:
    if isinstance(given, list) and given:
        if not all(type(each) is int and each >= 0 for each in given):
            raise ConfigError(f"seeds = {given!r}: write whole numbers, 0 or more")
        if len(set(given)) < len(given):
            raise ConfigError("seeds: one of them stands there twice")
        return tuple(given)
    found = _Seeds.checked(given if isinstance(given, dict) else {"count": given}, "seeds")
    return tuple(range(found.first, found.first + found.count))

"""What a campaign file of `vrspray campaign` can hold, and what its dataset does."""

from __future__ import annotations

import math

from sitl.campaign.dataset import AFTER, BEFORE
from sitl.campaign.flying import BY_RATE, BY_RATE_COUNTS, figure_types
from sitl.campaign.settings import KINDS, Kind, plant_names

INTRODUCTION = """# Campaign files

`vrspray campaign FILE` reads a TOML file and flies what it says ([how](../howto/fly-a-campaign.md)). What is not known is
refused with exit code 2. Ready ones: `vrspray examples copy campaigns`.

| Key | |
| --- | --- |
| `version` | 1 |
| `name` | what tables and pictures call it; default: the file's name |
| `seeds` | a number N for 1 to N, a list, or `{first = 1, count = 20}`; every setting is flown with each; more of them, behind the others, continue a campaign |
| `[fixed]` | settings of all flights |
| `[[case]]` | `name`, and settings of its flights: a list of flights, or beside a design, each with all of it |
| `[design] kind` | `grid` (default), `latin-hypercube`, `sobol` or `morris` |
| `[design] samples` | points of a hypercube; of `sobol` a power of two, N (k + 2) points for k settings; of `morris`, trajectories of k + 1 points. Sensitivity has intervals from 64 (`sobol`) and 16 (`morris`) on |
| `[design] seed` | of the points that are drawn; default 1 |
| `[design] second_order` | `sobol` with pairs: N (2k + 2) points |
| `[[vary]] set` | a setting that the design varies |
| `[[vary]] values`, or `low` and `high` | its values; a grid takes `low`, `high` and `steps`, too |

## Settings

Without `flight.config` and `flight.mission`, flights go over the field of Wang et al. 2024, as `vrspray demo` flies it. Names of
files are relative to the campaign file.

| Setting | Value | |
| --- | --- | --- |
| `config.KEY` | any | any key of the [configuration](configuration.md), such as `config.lag.on_s` or `config.prescription.overlap` |
"""
MEANINGS: dict[str, str] = {
    "flight.config": "the companion's configuration",
    "flight.mission": "`.plan` or `.waypoints`",
    "flight.scenario": "timed faults, as for `sitl fly`",
    "flight.field": "the published one (default), or a hard condition with its own rates and way of flying",
    "flight.fidelity": "default averaged",
    "flight.output": "default: gpio; with `flight.config` as configured",
    "flight.board": "driver board behind servo outputs",
    "flight.meter_rate_hz": "0: no flow meter",
    "flight.perfect": "fly with perfect knowledge, too: `limit_ratio`; twice the time",
    "flight.cpu_max_s": "processor time after which a flight is given up, a row with this error; default 600",
    "vehicle.kind": "drawn (default), or flown: gusts, turns and position errors as in logs of real flights",
    "vehicle.speed_m_s": "default 5, or the mission's",
    "vehicle.acceleration_m_s2": "",
    "vehicle.gust_m_s": "1 sd along the way; default: the vehicle's, 1 drawn",
    "vehicle.gust_time_s": "time constant; default: the vehicle's, 1.5",
    "vehicle.corners": "how corners are flown",
    "vehicle.position_rate_hz": "",
    "vehicle.estimator_lag_s": "how old positions are when they are sent; default 0.031",
    "vehicle.noise": "of positions; default true",
    "map.rate_factor": "times every rate",
    "map.rates": "the published field's: scaled by 5 m/s over the speed (default), or as they are",
    "method.name": "ours as configured (default); P1's controller, with its look-aheads; ours with every valve "
    "calibrated; perfect knowledge",
    "method.look_ahead_s": "P1's controller with this look-ahead",
    "method.dose": "P1's controller: by its Eq. 2, or by the measured curve",
    "method.controller": "`module:Class` or `file.py:Class`; with `--allow-code` only; a file travels to workers, a module must be there",
    "plant.profile": "a sprayer's name, or a `.toml` file",
    "plant.flow_law": "true flow between measured points",
    "plant.scatter": "whether valves differ; default true",
    "plant.known": "the controller has this sprayer's curve, PWM and measured lags, not the example's",
    "error.lag_short_s": "what the controller's lags are too short by",
    "error.lags": "which of them; default all",
    "error.behind_m": "how far behind the vehicle its position is told",
    "error.along_m": "ground offset along the published field's passes",
    "error.across_m": "and across them",
    "error.drift_along_m": "how far wind carries droplets along them",
    "error.drift_across_m": "and across them",
}
DATASET = """
## The dataset

`DIR/flights/part=00000/flights.parquet` and so on: one hive-partitioned Parquet dataset for DuckDB, pandas or Polars, a row a
flight. `DIR/manifest.json` has the hashes of the campaign, of its files and of the program, and all versions. `DIR/log.jsonl`
has times; it is no part of the dataset.

| Column | |
| --- | --- |
"""


def page() -> str:
    """Return the page."""
    assert set(MEANINGS) == set(KINDS), set(MEANINGS) ^ set(KINDS)
    rows = [f"| `{name}` | {_value(kind)} | {MEANINGS[name]} |" for name, kind in KINDS.items()]
    numbers = ", ".join(f"`{name}`" for name in plant_names())
    rows.append(f"| {numbers} | a number | the sprayer, as in its profile |")
    columns = [
        (_names(BEFORE), "the flight's number, its case, the number of its settings, its seed"),
        ("each varied setting", "its value, by its dotted name; a list as JSON"),
        (_names(figure_types()), "[metrics](metrics.md); NULL where there was nothing to measure"),
        (_names((*BY_RATE, *BY_RATE_COUNTS)), "lists, an entry for each rate of the map"),
        (_names(AFTER), "what flew, why it did not spray, and why there are no figures"),
    ]
    shown = [f"| {names} | {text} |" for names, text in columns]
    return INTRODUCTION + "\n".join(rows) + "\n" + DATASET + "\n".join(shown) + "\n"


def _names(names: object) -> str:
    return ", ".join(f"`{name}`" for name in names)  # type: ignore[attr-defined]


def _value(kind: Kind) -> str:
    if kind.words:
        return ", ".join(kind.words)
    if kind.type is float:
        most = "" if kind.most == math.inf else f" to {kind.most:g}"
        return f"{kind.least:g}{most}"
    return {str: "text", bool: "true, false"}[kind.type]

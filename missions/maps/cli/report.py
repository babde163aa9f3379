"""What `map check` says to a person: the map in a few lines, its problems on at most a screen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from companion.cli.answer import problem_line
from companion.wording import counted

RATES_SHOWN_MAX = 12
# Problems of one kind, and kinds, that are written out; all of them are in --json.
ALIKE_SHOWN_MAX = 2
KINDS_SHOWN_MAX = 15
LINE_MAX = 500


def report_lines(file: Path, result: Mapping[str, Any]) -> list[str]:
    """Return the lines for a person."""
    return [
        f"{file}: {result['format']}, {result['crs']}",
        _extent(result),
        _rates(result),
        _amount(result),
        _ground(result),
        *_problems(result["problems"]),
        _verdict(result),
    ]


def _extent(result: Mapping[str, Any]) -> str:
    if result["rows"] is not None:
        along, across = result["cell_m"]
        return (
            f"{result['rows']} rows x {result['columns']} columns of cells, {along:.2f} m x "
            f"{across:.2f} m; {result['zones']} have a rate, {_area(result)}"
        )
    zones, parts, holes = (counted(result[f"{name}s"], name) for name in ("zone", "part", "hole"))
    in_parts = f" in {parts}" if result["parts"] != result["zones"] else ""
    with_holes = f" with {holes}" if result["holes"] else ""
    return f"{zones}{in_parts}{with_holes}, {_area(result)}"


def _area(result: Mapping[str, Any]) -> str:
    """Return the ground that is sprayed, and that of the file where it reaches further."""
    own, inside = result["map_area_ha"], result["area_ha"]
    if abs(own - inside) <= 5e-5:
        return f"{inside:.4f} ha"
    return f"{own:.4f} ha, {inside:.4f} ha to spray"


def _rates(result: Mapping[str, Any]) -> str:
    rates: Sequence[float] = result["rates_l_ha"]
    if len(rates) <= RATES_SHOWN_MAX:
        text = " ".join(f"{value:g}" for value in rates) or "none"
    else:
        text = f"{len(rates)} from {rates[0]:g} to {rates[-1]:g}"
    return f"rates [L/ha] from {result['rate_field']!r} in {result['unit']}: {text}"


def _amount(result: Mapping[str, Any]) -> str:
    mean = result["mean_rate_l_ha"]
    text = f"{result['litres']:.1f} L in all"
    text += "" if mean is None else f", {mean:.4g} L/ha in the mean"
    text += f"; {result['zero_ha']:.3f} ha at rate 0" if result["zero_ha"] else ""
    return text + (
        f"; {result['no_rate_ha']:.3f} ha without a rate" if result["no_rate_ha"] else ""
    )


def _ground(result: Mapping[str, Any]) -> str:
    if result["boundary_ha"] is None:
        boundary = "none; the outline of all zones is the border"
    else:
        boundary = f"{result['boundary_ha']:.4f} ha, from the {result['boundary_from']}"
    default = result["default_rate_l_ha"]
    south, east = result["bounds"][1], result["bounds"][2]
    west, north = result["bounds"][0], result["bounds"][3]
    return (
        f"from {south:.5f}, {west:.5f} to {north:.5f}, {east:.5f}; boundary: {boundary}; "
        f"default rate: {'none' if default is None else f'{default:g} L/ha'}"
    )


def _problems(problems: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each problem; many of a kind stand together and are counted."""
    ranks = {problem["code"]: rank for rank, problem in reversed(list(enumerate(problems)))}

    def kind(problem: Mapping[str, Any]) -> tuple[bool, int]:
        return problem["severity"] != "error", ranks[problem["code"]]

    kinds = [list(alike) for _, alike in groupby(sorted(problems, key=kind), key=kind)]
    for alike in kinds[:KINDS_SHOWN_MAX]:
        for problem in alike[:ALIKE_SHOWN_MAX]:
            line = f"{problem_line(problem)} [{problem['code']}]"
            yield line if len(line) <= LINE_MAX else f"{line[: LINE_MAX - 3]}..."
        left = len(alike) - ALIKE_SHOWN_MAX
        if left > 0:
            yield f"  and {left} more of the kind {alike[0]['code']} (--json lists them)"
    if len(kinds) > KINDS_SHOWN_MAX:
        yield f"and {len(kinds) - KINDS_SHOWN_MAX} more kinds of warnings (--json lists them)"


def _verdict(result: Mapping[str, Any]) -> str:
    severities = [problem["severity"] for problem in result["problems"]]
    found = [
        counted(severities.count(name), name) for name in ("error", "warning") if name in severities
    ]
    return ("ok" if result["ok"] else "not usable") + (f": {', '.join(found)}" if found else "")

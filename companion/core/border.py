"""When a strip touches the border: its whole width counts, in the skewed frame of path and boom."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from companion.core.boom import Boom, Paths, time_on_chord
from companion.core.frame import Floats, Offset

# Which strip meets which edge, and the least and greatest way along the path where it does.
Contact = tuple[int, int, tuple[float, float]]
# Contacts of a strip with the sides of what an edge sweeps, to those with the edge (`drift.py`).
Merge = Callable[[list[Contact]], list[Contact]]
# From when until when a strip is closed.
Intervals = list[tuple[float, float]]

# A boom that lies nearly along its own motion covers no strip that could be judged.
ACROSS_MIN = 0.2


def add_contacts(
    paths: Paths,
    ends: Floats,
    boom: Boom,
    buffer_m: float,
    closed: list[Intervals],
    merge: Merge | None,
) -> None:
    """Add to `closed` when an edge of the border lies within a strip."""
    if not len(ends):
        return
    chords = len(paths.time_s) - 1
    half_m = boom.half_width_m + buffer_m
    for chord in range(chords):
        if chords == 1:
            contacts = _contacts_of_one_chord(paths, ends, half_m.tolist())
        else:
            contacts = _contacts(paths, chord, ends, half_m)
        if contacts is None:
            for intervals in closed:
                intervals.append((paths.time_s[chord], paths.time_s[chord + 1]))
            continue
        length = paths.length_m[:, chord].tolist()
        for valve, _, limits in contacts if merge is None else merge(contacts):
            first, last = limits[0] - buffer_m, limits[1] + buffer_m
            reach = length[valve]
            if last < 0.0 or first > reach:
                continue
            begin = time_on_chord(paths, chord, valve, max(first, 0.0), reach)[0]
            end = time_on_chord(paths, chord, valve, min(last, reach), reach)[0]
            beyond = last > reach and chord == chords - 1
            closed[valve].append((begin, math.inf if beyond else end))


def _contacts_of_one_chord(paths: Paths, ends: Floats, half_m: list[float]) -> list[Contact] | None:
    """Return the contacts on a straight pass, where all strips go the same way.

    In plain numbers, as few edges are near. None where the boom lies along its own motion.
    """
    rx, ry = paths.right[0]
    edges = ends.tolist()
    contacts: list[Contact] = []
    for valve, (px, py, dx, dy, length, half) in enumerate(
        zip(
            paths.east_m[:, 0].tolist(), paths.north_m[:, 0].tolist(),
            paths.step_east_m[:, 0].tolist(), paths.step_north_m[:, 0].tolist(),
            paths.length_m[:, 0].tolist(), half_m, strict=True,
        )
    ):  # fmt: skip
        safe = max(length, 1e-12)
        ux, uy = dx / safe, dy / safe
        turn = (dx * ry - dy * rx) / safe  # sine of the angle from path to boom
        if not abs(turn) >= ACROSS_MIN:
            return None
        for edge, (x0, y0, x1, y1) in enumerate(edges):
            across_0 = (ux * (y0 - py) - uy * (x0 - px)) / turn
            across_1 = (ux * (y1 - py) - uy * (x1 - px)) / turn
            if (across_0 > half and across_1 > half) or (across_0 < -half and across_1 < -half):
                continue
            along_0 = ((x0 - px) * ry - (y0 - py) * rx) / turn
            along_1 = ((x1 - px) * ry - (y1 - py) * rx) / turn
            limits = _clip((across_0, along_0), (across_1, along_1), half)
            contacts.append((valve, edge, limits))
    return contacts


def _contacts(paths: Paths, chord: int, ends: Floats, half_m: Floats) -> list[Contact] | None:
    """Return the contacts of one chord, in the skewed frame of path and boom; None as above."""
    px, py = paths.east_m[:, chord], paths.north_m[:, chord]
    dx, dy = paths.step_east_m[:, chord], paths.step_north_m[:, chord]
    rx, ry = paths.right[chord]
    safe = np.maximum(paths.length_m[:, chord], 1e-12)
    turn = (dx * ry - dy * rx) / safe  # sine of the angle from path to boom
    if not np.abs(turn).min() >= ACROSS_MIN:
        return None
    ux, uy, t2 = (dx / safe)[:, None], (dy / safe)[:, None], turn[:, None]
    x, y = ends[:, 0::2].ravel() - px[:, None], ends[:, 1::2].ravel() - py[:, None]
    across = (ux * y - uy * x) / t2
    across_0, across_1 = across[:, 0::2], across[:, 1::2]
    half = half_m[:, None]
    touching = (np.minimum(across_0, across_1) <= half) & (np.maximum(across_0, across_1) >= -half)
    valves, hits = touching.nonzero()
    if not len(valves):
        return []
    along = (x * ry - y * rx) / t2
    along_0, along_1 = along[:, 0::2], along[:, 1::2]
    return [
        (valve, hit, _clip(
            (float(across_0[valve, hit]), float(along_0[valve, hit])),
            (float(across_1[valve, hit]), float(along_1[valve, hit])),
            float(half_m[valve]),
        ))
        for valve, hit in zip(valves.tolist(), hits.tolist(), strict=True)
    ]  # fmt: skip


def _clip(a: tuple[float, float], b: tuple[float, float], half_m: float) -> tuple[float, float]:
    """Return the least and greatest `along` of the edge a-b within the strip's width."""
    (u0, s0), (u1, s1) = a, b
    if u0 == u1:
        return min(s0, s1), max(s0, s1)
    ends = []
    for u, s in (a, b):
        held = min(max(u, -half_m), half_m)
        ends.append(s if held == u else s0 + (s1 - s0) * (held - u0) / (u1 - u0))
    return min(ends), max(ends)


# ---------------------------------------------- liquid that lands beside its nozzle (`drift.py`)

SIDES = 4


def swept(ends: Floats, offset_m: Offset) -> Floats:
    """Return the four sides of what each edge sweeps when it is moved by the offset, in turn.

    A strip where liquid lands meets what an edge sweeps exactly while ground between it and its
    nozzle lies on that edge.
    """
    first, last = ends[:, :2], ends[:, 2:]
    moved = np.array(offset_m)
    sides = np.stack(
        [
            ends,
            np.hstack([first + moved, last + moved]),
            np.hstack([first, first + moved]),
            np.hstack([last, last + moved]),
        ],
        axis=1,
    )
    return sides.reshape(-1, 4)


def joined(contacts: list[Contact]) -> list[Contact]:
    """Return, of contacts with the sides of `swept`, one for each edge that it was made of.

    What an edge sweeps is convex: a strip that moves along touches it from the first contact with
    any of its sides to the last, and lies within it between.
    """
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for valve, side, (low, high) in contacts:
        key = (valve, side // SIDES)
        before = found.get(key, (low, high))
        found[key] = (min(low, before[0]), max(high, before[1]))
    return [(valve, edge, limits) for (valve, edge), limits in found.items()]

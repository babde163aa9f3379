"""Means over PWM periods: what turns a train of pulses into a flow.

All arrays are sampled at even steps; a period need not be a whole number of steps. Beyond its
ends an array keeps its last value.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def shifted(values: Floats, steps: float) -> Floats:
    """Return `values` as they are `steps` later (earlier if negative), between samples linear.

    >>> shifted(np.array([0.0, 1.0, 2.0, 3.0]), 0.5).tolist()
    [0.5, 1.5, 2.5, 3.0]
    """
    whole = math.floor(steps)
    part = steps - whole
    last = len(values) - 1
    moved = np.empty(len(values) + 1)
    # What lies beyond an end, then the array itself: slices are quicker than an index of each.
    before = min(max(-whole, 0), len(moved))
    moved[:before] = values[0]
    kept = values[max(whole, 0) : max(whole, 0) + len(moved) - before]
    moved[before : before + len(kept)] = kept
    moved[before + len(kept) :] = values[last]
    mixed: Floats = moved[:-1] * (1.0 - part) + moved[1:] * part
    return mixed


def rise_over(values: Floats, steps: float) -> Floats:
    """Return by how much `values` rise over `steps` centred at each sample."""
    return shifted(values, steps / 2) - shifted(values, -steps / 2)


def boxed(values: Floats, steps: float) -> Floats:
    """Return the centred mean of `values` over `steps`, exact for lines and short of the ends."""
    half = math.ceil(steps / 2) + 1
    padded = np.concatenate((np.full(half, values[0]), values, np.full(half, values[-1])))
    padded -= values[0]
    integral = np.concatenate(([0.0], np.cumsum(0.5 * (padded[1:] + padded[:-1]))))
    smooth: Floats = rise_over(integral, steps)[half:-half] / steps + values[0]
    return smooth


def smoothed(values: Floats, steps: float) -> Floats:
    """Return the mean over a triangle of two periods: twice the mean over one.

    Once is enough when the pulses keep the nominal period. After a restart the period is up to
    10 % off until the stagger is back; one mean then leaves 10 % of the ripple, two leave 1 %.
    """
    return boxed(boxed(values, steps), steps)

"""The flow of a nozzle set by its duty: three laws for what a table leaves open.

A bucket test tells the flow at a few duties. What lies between nobody has measured, so that a
figure of a flight must not rest on one reading of it, least of all on the controller's own.

- `smooth`: through every point without a kink (M. Steffen, Astron. Astrophys. 239, 1990, 443-450);
- `straight`: through every point, straight between them;
- `offset`: what a valve does by its mechanics. Each pulse delivers as long as it lasts, less what
  opening takes more than closing: `flow = k (duty - d0)`, by least squares near the points; from
  the last duty with a gap the flow goes straight up to that of an open valve.

Below the first point the flow falls in proportion to zero, by every law.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FlowLaw = Literal["smooth", "straight", "offset"]
FLOW_LAWS: tuple[FlowLaw, ...] = get_args(FlowLaw)


def flow_by_law(
    law: FlowLaw, duty: tuple[float, ...], flow_l_min: tuple[float, ...], wanted: Floats
) -> Floats:
    """Return the flow [L/min] at the duties `wanted`, from the measured points.

    >>> points = ((0.2, 0.5, 1.0), (1.0, 2.0, 4.0))
    >>> [float(flow_by_law(law, *points, np.array([0.5]))[0]) for law in ("smooth", "straight")]
    [2.0, 2.0]
    >>> flow_by_law("straight", *points, np.array([0.0, 0.1, 0.75])).tolist()
    [0.0, 0.5, 3.0]
    """
    x, y = np.array(duty), np.array(flow_l_min)
    at = np.clip(wanted, x[0], x[-1])
    if law == "smooth":
        flow = _smooth(x, y, at)
    elif law == "straight":
        flow = np.interp(at, x, y)
    else:
        flow = _offset(x, y, at)
    below = np.clip(wanted / x[0], 0.0, 1.0) if x[0] > 0.0 else (wanted > 0.0).astype(np.float64)
    result: Floats = flow * below
    return result


def _smooth(x: Floats, y: Floats, at: Floats) -> Floats:
    """Return Steffen's curve: monotone between the points, its slope without a jump.

    Its ends are straight on: nobody knows of a bend before the first or behind the last point.
    """
    h = np.diff(x)
    rise = np.diff(y) / h
    slope = np.concatenate((rise[:1], np.zeros(len(x) - 2), rise[-1:]))
    if len(x) > 2:
        left, right = rise[:-1], rise[1:]
        parabola = (left * h[1:] + right * h[:-1]) / (h[:-1] + h[1:])
        slope[1:-1] = 2.0 * np.minimum(np.minimum(left, right), 0.5 * parabola)
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(h) - 1)
    t = at - x[i]
    bend = (3.0 * rise[i] - 2.0 * slope[i] - slope[i + 1]) / h[i]
    twist = (slope[i] + slope[i + 1] - 2.0 * rise[i]) / h[i] ** 2
    result: Floats = y[i] + t * (slope[i] + t * (bend + t * twist))
    return result


def _offset(x: Floats, y: Floats, at: Floats) -> Floats:
    """Return k (duty - d0) up to the last duty below 1, straight from there to the last flow."""
    pulsed = x < 1.0
    if pulsed.sum() < 2:
        return np.interp(at, x, y)
    k, above = np.polyfit(x[pulsed], y[pulsed], 1)
    line = np.clip(k * at + above, 0.0, y[-1])
    last = float(x[pulsed][-1])
    if last == x[-1]:
        return np.asarray(line)
    end = min(k * last + above, float(y[-1]))
    result: Floats = np.where(at <= last, line, np.interp(at, (last, x[-1]), (end, y[-1])))
    return result

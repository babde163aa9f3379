"""What the simulated sprayers truly do, and where each figure comes from."""

from __future__ import annotations

from dataclasses import fields

from sitl.profile import PROFILES, TYPICAL, Imperfections

INTRODUCTION = """# Simulated sprayers

The truth of the [simulation](../explanation/simulation.md): what each sprayer does and where its figures come from. The
controller is told none of it. It knows a bucket test and lags, as a user measures them, and has to learn the rest by
calibration. `vrspray sitl fly --plant NAME` flies one of these files, `--plant FILE.toml` your own.

| Name | Sprayer | Lag | Configuration |
|---|---|---|---|
| `wang-2024` | Wang et al. 2024: six PWM valves, 11 Hz, a hose between valve and nozzle | 0.10 s | `examples/anyang` |
| `orchard-180` | made up, larger: 15 Hz, 40 L/min | 0.07 s | `examples/orchard` |
| `pinpoint` | after Mangus et al. 2017: 10 Hz, valve at the nozzle | 0.01 s | `examples/pinpoint` |
| `pump` | a pump's speed makes the flow; one shut-off valve | 1.9 s up, 1.4 s down | `examples/pump` |
| `pump-sections` | the same pump and six on-off sections | 1.9 s up, 1.4 s down; valves 0.04 to 0.06 s | `examples/pump-sections` |
| `atomiser` | a quicker pump, two sections, two rotary atomisers | 0.6 s up, 0.5 s down | `examples/atomiser` |
| `pwm-pump` | `wang-2024` behind a pump that starts with the spraying | 0.10 s; 0.55 s from a stop | - |

The pump's response of 3.8 s up and 2.6 s down to within 10 % of a step is that of Koo 2019.

## Flow between measured points

A bucket test tells the flow at a few duties. What lies between nobody has measured, so `--flow-law` or `flow_law` chooses:

| Law | The flow against the duty cycle |
|---|---|
| `smooth` (default) | through every point, without a kink: M. Steffen, Astron. Astrophys. 239 (1990) 443-450 |
| `straight` | straight lines between the points, as the program reads a table |
| `offset` | a valve's mechanics: each pulse loses the time that opening takes more than closing; least squares near the points |

Below the first point the flow falls in proportion to zero.

## Imperfect parts

A table `[imperfections]` in a sprayer's file gives its valves what real parts have and the program does not model. All of it
is off by default. *Typical* is `TYPICAL` of `sitl/profile.py`, which the measurements of
[single valves](../measurements/valves.md) use.

| Key | What it does | Default | Typical | After |
|---|---|---|---|---|"""
# What a key does, and where its typical value comes from.
MEANINGS = {
    "offset_scatter_s": (
        "a valve delivers so much longer than its pulse, at every duty (1 sd between valves)",
        "data sheets: opening and closing of solenoids repeat within 0.5 to 1 ms between units",
    ),
    "curvature_scatter": (
        "so much more of its flow at full duty than at none (1 sd between valves)",
        "pulsed nozzles depart from a straight line by 1 to 3 %; Wang et al. 2024, Table 2, by 4 %",
    ),
    "interaction": (
        "share of its flow that a valve loses while all others are open",
        "nozzle pressure falls by 5 to 10 % from few open valves to all (Fabula et al. 2021; "
        "Wang et al. 2024: 290 and 227 kPa); the flow by half of that",
    ),
    "ripple": ("the supply swings by this share", "a regulator that hunts: an assumption"),
    "ripple_hz": ("how often it swings", "an assumption"),
    "rest_lag_s": ("a valve that was shut opens so much later", "an assumption"),
    "rest_time_s": ("after this time of rest, 63 % of it", "an assumption"),
    "pressure_lag_s": (
        "a valve that opens while no other is open opens later: the pressure is highest",
        "an assumption",
    ),
    "warming": (
        "more flows once coils, hoses and water are warm",
        "water 10 K warmer and an elastomer seat: an assumption",
    ),
    "warming_time_s": ("after this time, 63 % of it", "an assumption"),
}
DRAWN = """
Beside these stand what every file has under `[flow]` and `[meter]`: valves differ in flow (`flow_scatter`) and in lag
(`lag_scatter`), and the flow meter has an unknown gain (`gain_spread`) and noise. A seed draws them.
"""


def page() -> str:
    """Return the page: the typical parts, and each sprayer's file with its sources."""
    default = Imperfections()
    rows = [
        f"| `{each.name}` | {MEANINGS[each.name][0]} | {getattr(default, each.name):g} | "
        f"{getattr(TYPICAL, each.name):g} | {MEANINGS[each.name][1]} |"
        for each in fields(Imperfections)
    ]
    parts = [INTRODUCTION, *rows, DRAWN]
    for path in sorted(PROFILES.glob("*.toml")):
        text = path.read_text(encoding="utf-8").rstrip()
        parts.append(f"## {path.stem}\n\n```toml\n{text}\n```\n")
    return "\n".join(parts)

"""What each figure means, in one line, with its unit; the whole is in docs/metrics.md."""

from __future__ import annotations

DEFINITIONS: dict[str, tuple[str, str, str]] = {
    "lag_distance_m": (
        "Lag distance",
        "m",
        "from a boundary to where a sharp step would have delivered the same volume; + is too late",
    ),
    "settled_lag_distance_m": (
        "Settled lag distance",
        "m",
        "to where the flow stays within 10 % of the step at its new target, as Wang et al. 2024",
    ),
    "spraying_accuracy_percent": (
        "Spraying accuracy",
        "%",
        "mean of 1 - |applied - asked| / asked of the total flow, transitions included; samples "
        "where nothing is asked are left out and counted",
    ),
    "settled_accuracy_percent": (
        "Settled accuracy", "%", "the same, from 3 s after a change on",
    ),
    "starting_accuracy_percent": (
        "Starting accuracy", "%", "the same, in the first 3 s after a start",
    ),
    "misapplied_percent": (
        "Misapplied",
        "%",
        "what the ground got too much and too little, added up, over what was prescribed",
    ),
    "border_margin_m": (
        "Border margin",
        "m",
        "from where the spray ended, or began, to the border; 0 or more: nothing fell outside",
    ),
    "off_target_ml": ("Outside", "mL", "volume outside the border or in exclusions"),
    "gap_m2": ("Gaps", "m\u00b2", "ground left out at switches on and off"),
    "overlap_m2": ("Overlap", "m\u00b2", "ground treated beyond the boundary at switches"),
    "volume_error_percent": (
        "Volume error", "%", "applied less prescribed volume over the prescribed, where was flown",
    ),
    "apart": (
        "Apart",
        "changes",
        "not measured: below 8 %, too close together, at the end of the valves' range, or at the "
        "border",
    ),
    "missed": ("Missed", "changes", "never happened"),
}  # fmt: skip

CAUSES: dict[str, str] = {
    "operator": "rate changed by the operator",
    "inhibit": "held closed by the safety layer",
    "edge": "border rule: nothing may fall outside",
    "change": "boundary between two rates",
    "saturation": "rate out of the nozzles' range",
    "acceleration": "changing speed",
    "overlap": "treated twice",
    "skip": "left out",
    "unexplained": "unexplained",
}

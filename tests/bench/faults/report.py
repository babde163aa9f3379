"""The table of a campaign, as JSON and as a page of Markdown, docs/measurements/faults.md."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tests.bench.faults.cases import Kind
from tests.bench.faults.judge import Verdict
from tests.bench.faults.place import ROOT

PAGE = ROOT / "docs" / "measurements" / "faults.md"
HEAD = """<!-- Written by `make faults ARGS=--page`; do not edit. -->

# Fault campaign

Short passes of the real `vrspray run` in real time, one fault each at a random moment.

- *GPIO*: the lines of a simulated chip, which release when their process dies, as a Raspberry Pi's
  do with `dtparam=strict_gpiod`. A chip that has gone is closed by the ALIVE line's monostable.
  *Servo*: the guardian, a process beside the companion, closes when that is killed or stopped.
  Behind it stands an autopilot with the watchdog script (*script*), or a driver board that closes
  when its signal stops changing (*dither*). Add one servo frame and the valve's own closing time.
- *Closed after* counts from the message that reports the fault, from the signal or the loss of the
  link, or from the moment at which the limit of age is reached; 0: all were closed by then.
- *Ordered outside* is what orders put outside the border, at the true position; *held outside* is
  what flowed there because a dead or stopped process could not close before its limit.
- A flight in which the valve engine refuses to start on a busy computer is flown again.
"""
PROSE_WIDTH = 120
_OUTPUTS = {"gpio": "GPIO", "script": "servo, script", "dither": "servo, dither"}


def rows(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Return a row for each kind and output that was flown."""
    found = []
    for kind in Kind:
        for output in _OUTPUTS:
            group = [one for one in verdicts if (one.kind, one.output) == (kind, output)]
            if group:
                found.append(_row(kind, output, group))
    return found


def _row(kind: Kind, output: str, group: Sequence[Verdict]) -> dict[str, Any]:
    closed = [one.closed_s for one in group]
    return {
        "fault": str(kind),
        "output": output,
        "flights": len(group),
        "to_the_border": sum(one.crossed for one in group),
        "closed_mean_s": round(sum(closed) / len(closed), 4),
        "closed_worst_s": round(max(closed), 4),
        "limit_s": group[0].limit_s,
        "ordered_outside_ml": round(sum(one.ml for one in group), 3),
        "held_outside_ml": round(sum(one.held_ml for one in group), 3),
        "wrong": sum(bool(one.wrong) for one in group),
    }


def result(
    verdicts: Sequence[Verdict], not_flown: Sequence[str], about: dict[str, Any]
) -> dict[str, Any]:
    """Return everything that is known of a campaign."""
    late = sorted(one.late_s for one in verdicts)
    waited = sorted(one.waited_s for one in verdicts)
    return {
        **about,
        "flights": len(verdicts),
        "not_flown": list(not_flown),
        "wrong": [
            f"flight {one.number}, {one.kind}, {one.output}: {text} "
            f"({1e3 * one.waited_s:.0f} ms waited for a core)"
            for one in verdicts
            for text in one.wrong
        ],
        "ordered_outside_ml": round(sum(one.ml for one in verdicts), 3),
        "held_outside_ml": round(sum(one.held_ml for one in verdicts), 3),
        "vehicle_late_median_s": round(late[len(late) // 2], 4) if late else None,
        "vehicle_late_worst_s": round(late[-1], 4) if late else None,
        "companion_waited_median_s": round(waited[len(waited) // 2], 4) if waited else None,
        "companion_waited_worst_s": round(waited[-1], 4) if waited else None,
        "rows": rows(verdicts),
    }


def page(found: dict[str, Any]) -> str:
    """Return the page."""
    table = "\n".join(_lines(found["rows"]))
    wrong, not_flown = len(found["wrong"]), len(found["not_flown"])
    words = (
        f"`{found['command']}`: {found['flights']} flights, seed {found['seed']}, "
        f"{found['lanes']} at a time, {found['wall_s'] / 60.0:.0f} min; "
        f"{wrong or 'no'} limit{'' if wrong == 1 else 's'} broken, "
        f"{not_flown or 'no'} flight{'' if not_flown == 1 else 's'} without spraying, "
        f"{found['repeated'] or 'none'} flown again as the computer was too busy to begin, "
        f"{found['ordered_outside_ml']:g} mL ordered outside. "
        f"The computer: the vehicle was late by {_ms(found['vehicle_late_median_s'])} at worst in "
        f"the median flight, {_ms(found['vehicle_late_worst_s'])} in the worst; while it was "
        f"watched the companion waited for a core for {_ms(found['companion_waited_median_s'])} in "
        f"all (median), {_ms(found['companion_waited_worst_s'])} (worst)."
    )
    # Hyphens and the command stay whole.
    prose = textwrap.fill(words, PROSE_WIDTH, break_on_hyphens=False, break_long_words=False)
    return f"{HEAD}\n{prose}\n\n{table}\n"


def _ms(time_s: float) -> str:
    return f"{1e3 * time_s:.0f} ms"


def _lines(found: Iterable[dict[str, Any]]) -> Iterable[str]:
    yield (
        "| Fault | Outputs | Flights | to the border | Closed after, mean | worst | Limit | "
        "Ordered outside | Held outside | Broken |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for row in found:
        yield (
            f"| {row['fault']} | {_OUTPUTS[row['output']]} | {row['flights']} | "
            f"{row['to_the_border']} | {row['closed_mean_s']:.3f} s | "
            f"{row['closed_worst_s']:.3f} s | {row['limit_s']:g} s | "
            f"{row['ordered_outside_ml']:g} mL | {row['held_outside_ml']:.1f} mL | "
            f"{row['wrong'] or 'none'} |"
        )


def write_page(found: dict[str, Any], path: Path = PAGE) -> None:
    """Write the page."""
    path.write_text(page(found), encoding="utf-8")

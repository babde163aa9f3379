"""The guided click: what is asked, and what an answer or a metered flow makes of each valve."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from companion.core.ground_task import GroundKind, GroundTask, Phase
from companion.core.liquid_clicks import ClickFinding, ClickJudgement
from companion.core.types import FaultKind
from companion.doctor.check import Check, fail, not_applicable, ok, warn

# Twice, as in the dry click; a second each, so that a turbine's pulses or whole millilitres of the
# autopilot tell a tenth of one valve's flow (docs/sensors.md). Between them the flow has ended.
WET_OPEN_S, WET_CLOSED_S, WET_TIMES = 1.0, 0.8, 2
# Nearer to the others than this one can spray on, and see to it; a loss beyond it closes in flight.
FAR_SHARE = 0.25
YES, NO, AGAIN, END = "y", "n", "again", "q"


def name_of(valve: str) -> str:
    """Return the name of the check of a valve.

    >>> name_of("left 1")
    'click-left-1'
    """
    return "click-" + "-".join(valve.split())


def wet_click(count: int, valve: int, *, open_s: float = WET_OPEN_S) -> GroundTask:
    """Return the piece of work that lets one of `count` valves deliver twice.

    >>> [phase.duty for phase in wet_click(2, 1).phases]
    [(0.0, 1.0), (0.0, 0.0), (0.0, 1.0), (0.0, 0.0)]
    """
    closed = (0.0,) * count
    opened = tuple(1.0 if number == valve else 0.0 for number in range(count))
    phases = []
    for number in range(WET_TIMES):
        at_s = number * (open_s + WET_CLOSED_S)
        phases += [Phase(at_s=at_s, duty=opened), Phase(at_s=at_s + open_s, duty=closed)]
    return GroundTask(
        kind=GroundKind.CLICK,
        phases=tuple(phases),
        seconds=WET_TIMES * (open_s + WET_CLOSED_S),
        is_whole=True,
    )


def answer_of(said: str, names: Sequence[str], asked: str) -> str | None:
    """Return what an answer means: one of the four, or another valve's name; None: nothing.

    A valve may be called as an answer is; then the answer counts.

    >>> answer_of(" Yes ", ("1", "2"), "1"), answer_of("2", ("1", "2"), "1")
    ('y', '2')
    >>> answer_of("1", ("1", "2"), "1"), answer_of("", ("1",), "1")
    ('y', None)
    """
    word = said.strip().lower()
    for meaning, words in (
        (YES, ("y", "yes")),
        (NO, ("n", "no")),
        (AGAIN, ("a", "again")),
        (END, ("q", "quit")),
    ):
        if word in words:
            return meaning
    other = next((name for name in names if name.lower() == word), None)
    return YES if other is not None and other == asked else other


def dry_check(valve: str, answer: str, *, channel: int | None) -> Check:
    """Return what an answer makes of a valve."""
    name, where = name_of(valve), f"output {channel}" if channel is not None else "its output"
    if answer == YES:
        return ok(name, "clicked")
    if answer == NO:
        fix = f"see the plug of its coil, its driver, and that it hangs on {where} (valve.channel)"
        return fail(name, "did not click", fix)
    fix = f"swap the wires, or correct valve.channel: {where} moves valve {answer}"
    return fail(name, f"valve {answer} clicked in its place", fix)


def not_clicked(valves: Sequence[str], why: str) -> Iterator[Check]:
    """Yield the checks of valves whose turn did not come."""
    yield from (not_applicable(name_of(valve), why) for valve in valves)


def wet_checks(judged: ClickJudgement, names: Sequence[str]) -> Iterator[Check]:
    """Yield what the metered flows make of the valves, and of what they have in common."""
    for found in judged.valves:
        yield _wet(found, names[found.valve])
    yield _common(judged)


def _wet(found: ClickFinding, valve: str) -> Check:
    name, kind = name_of(valve), found.kind
    if kind is FaultKind.METER_FAULT or found.share is None:
        fix = "see the meter's wiring and supply, then ask again"
        return fail(name, "the flow meter gave no sound count", fix)
    share = f"{100.0 * found.share:.0f} % of the others' flow"
    if kind is None:
        return ok(name, f"{share} ({100.0 * found.limit:.0f} % off would be seen)")
    if kind is FaultKind.STUCK_OPEN:
        fix = "close the tap, then free or change the valve"
        return fail(name, "delivers all the time: stuck open", fix)
    if kind is FaultKind.STUCK_CLOSED:
        fix = (
            "does it click (vrspray doctor --click)? then clean nozzle and strainer; else its wire"
        )
        return fail(name, "delivers nothing: dead, stuck closed or blocked", fix)
    judge = warn if abs(found.share - 1.0) <= FAR_SHARE else fail
    if kind is FaultKind.CLOG:
        return judge(name, f"{share}: clogged", "clean its nozzles and strainers")
    return judge(name, f"{share}: worn, or a leak behind it", "change its nozzles, see its hose")


def _common(judged: ClickJudgement) -> Check:
    name, fault = "click-flow", judged.fault
    if fault is FaultKind.METER_FAULT or judged.common is None:
        fix = "see the meter's wiring and supply, then ask again"
        return fail(name, "the flow meter gave no sound count", fix)
    share = f"valves deliver {100.0 * judged.common:.0f} % of what the table says"
    idle = f"{0.06 * judged.idle_ml_s:.2f} L/min with all closed"
    if fault is FaultKind.NO_FLOW:
        fix = "switch the pump on, open the tap, prime the lines (vrspray ground prime)"
        return fail(name, "no valve delivers anything", fix)
    if fault is FaultKind.SUPPLY:
        fix = "see pump, regulator and filter, or calibrate again (vrspray calibrate flow)"
        return warn(name, share, fix)
    if fault is FaultKind.STUCK_OPEN:
        return fail(
            name, f"{idle}: a valve stays open", "see which nozzle drips, change that valve"
        )
    if fault is FaultKind.LEAK:
        return fail(name, f"{idle}: a leak", "find it before the valves, or see which nozzle drips")
    return ok(name, f"{share}, {idle}")

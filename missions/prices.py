"""What choices between coverage, overlap, order and time cost, beside the plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from missions.demand import Rates
from missions.errors import PlanError
from missions.layouts import is_small
from missions.plan import LEAVE_PERCENT, Plan, Settings
from missions.planner import plan_mission
from missions.sheet import sheet
from missions.surroundings import NOTHING_AROUND, Surroundings

# What is offered where nothing is asked for: 1 % of the ground, 5 % of the litres.
LEAVE_MAX_PERCENT, OVERLAP_MAX_PERCENT = 1.0, 5.0
# A smaller gain is not worth a line of text.
LEAST_S, LEAST_L_PERCENT = 6.0, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Price:
    """Another plan of the same field: what it takes and leaves."""

    option: str
    swaths: int
    flight_s: float
    volume_l: float
    left_percent: float
    overlap_litres_percent: float


def prices(
    plan: Plan, rates: Rates, *, depots: tuple[tuple[float, float], ...],
    around: Surroundings = NOTHING_AROUND,
) -> Iterator[tuple[Price, str]]:  # fmt: skip
    """Yield the other choices with what they change, in words; for large fields, of the order."""
    settings = plan.settings
    now = _price("", plan)
    closes = plan.field.closes is not None and settings.border_buffer_m is not None
    choices = [*_choices(settings, now, closes=closes)] if _is_choice_of_lines(plan) else []
    if len(plan.sorties) > 1:
        how = "without" if settings.stripes else "with"
        choices.append((f"{how} --stripes", replace(settings, stripes=not settings.stripes)))
    for option, other in choices:
        try:
            there = plan_mission(plan.field, other, rates, depots=depots, around=around)
        except PlanError:
            continue
        price = _price(option, there)
        less_l = 100.0 * abs(price.volume_l - now.volume_l) / now.volume_l
        if abs(price.flight_s - now.flight_s) >= LEAST_S or less_l >= LEAST_L_PERCENT:
            yield price, _words(price, now)


def _is_choice_of_lines(plan: Plan) -> bool:
    return is_small(plan.field, plan.settings) and plan.settings.aircraft == 1


def no_choices(plan: Plan) -> str:
    """Return why there is no other choice to show."""
    if not _is_choice_of_lines(plan) and len(plan.sorties) < 2:
        return "none: --choices is for several sorties, or small fields and one aircraft"
    return f"none: no option saves {LEAST_S:g} s of flight or {LEAST_L_PERCENT:g} % of the litres"


def overlap_warnings(
    plan: Plan, overlap_litres_percent: float, *, is_stopped: bool = False
) -> tuple[str, ...]:
    """Return that more is sprayed twice than was asked for, where it is."""
    cap = plan.settings.overlap_max_percent
    if cap is None or overlap_litres_percent <= cap:
        return ()
    closing = plan.settings.switch_off_percent is None
    if is_stopped:
        return (
            f"{overlap_litres_percent:.1f} % of the litres are sprayed twice, above "
            f"--overlap-max {cap:g}: the search was stopped before it found less",
        )
    least = ", the least found for this field" if is_small(plan.field, plan.settings) else ""
    return (
        f"{overlap_litres_percent:.1f} % of the litres are sprayed twice{least}, above "
        f"--overlap-max {cap:g}; "
        + (
            "allow more to be left with --leave-max, or close valves over treated ground with "
            "coverage.switch_off_percent = 100 in the configuration"
            if closing
            else "allow more to be left with --leave-max"
        ),
    )


def twice_hint(plan: Plan, overlap_litres_percent: float) -> tuple[str, ...]:
    """Return what spares litres that fall twice, where that is worth a word and nothing does."""
    settings = plan.settings
    if not overlap_litres_percent > OVERLAP_MAX_PERCENT:
        return ()
    twice = f"{overlap_litres_percent:.1f} % of the litres fall twice"
    if not settings.valves and is_small(plan.field, settings):
        return (f"{twice}: --choices shows what fewer passes would leave, and save",)
    if not settings.valves or settings.switch_off_percent is not None:
        return ()
    return (
        f"{twice}: coverage.switch_off_percent = 100 has the companion close valves over treated "
        "ground, and the plan count on it",
    )


def _choices(settings: Settings, now: Price, *, closes: bool) -> Iterator[tuple[str, Settings]]:
    """Yield the options that are not taken, and the defaults of those that are."""
    if settings.leave_max_percent > LEAVE_PERCENT:
        yield "without --leave-max", replace(settings, leave_max_percent=LEAVE_PERCENT)
    else:
        leave = replace(settings, leave_max_percent=LEAVE_MAX_PERCENT)
        yield f"with --leave-max {LEAVE_MAX_PERCENT:g}", leave
    if settings.overlap_max_percent is not None:
        yield "without --overlap-max", replace(settings, overlap_max_percent=None)
    elif now.overlap_litres_percent > OVERLAP_MAX_PERCENT:
        cap = replace(settings, overlap_max_percent=OVERLAP_MAX_PERCENT)
        yield f"with --overlap-max {OVERLAP_MAX_PERCENT:g}", cap
        if settings.valves and settings.switch_off_percent is None:
            closing = replace(settings, switch_off_percent=100.0)
            yield "with coverage.switch_off_percent = 100", closing
        if closes and len(settings.valves) > 1 and not settings.ends_over:
            yield "with --ends-over", replace(settings, ends_over=True)


def _price(option: str, plan: Plan) -> Price:
    return Price(
        option=option,
        swaths=len(plan.lines),
        flight_s=plan.flight_s,
        volume_l=plan.volume_l,
        left_percent=100.0 - plan.coverage.reachable_percent,
        overlap_litres_percent=sheet(plan)["overlap_litres_percent"],
    )


def _words(price: Price, now: Price) -> str:
    """Return what another choice changes.

    >>> now = Price(option="", swaths=10, flight_s=300.0, volume_l=10.0, left_percent=0.05,
    ...             overlap_litres_percent=9.0)
    >>> _words(Price(option="with --leave-max 1", swaths=8, flight_s=222.0, volume_l=9.5,
    ...              left_percent=0.8, overlap_litres_percent=4.0), now)
    'with --leave-max 1: 2 passes less, 1.3 min less, 0.50 L less; 0.80 % left, 4.0 % of the litres twice'
    """  # noqa: E501
    changes = [
        _change(price.swaths - now.swaths, "{:.0f} pass", "{:.0f} passes"),
        _change((price.flight_s - now.flight_s) / 60.0, "{:.1f} min"),
        _change(price.volume_l - now.volume_l, "{:.2f} L"),
    ]
    changed = ", ".join(filter(None, changes)) or "no change"
    return (
        f"{price.option}: {changed}; {price.left_percent:.2f} % left, "
        f"{price.overlap_litres_percent:.1f} % of the litres twice"
    )


def _change(by: float, one: str, many: str | None = None) -> str:
    """Return a change in words; nothing where it rounds to none.

    >>> _change(-1.3, "{:.1f} min"), _change(1, "{:.0f} pass", "{:.0f} passes")
    ('1.3 min less', '1 pass more')
    """
    size = (one if many is None or abs(by) == 1 else many).format(abs(by))
    if not float(size.split()[0]):
        return ""
    return f"{size} {'more' if by > 0.0 else 'less'}"

"""What goes into the tank before each sortie: water, and every product in the order of mixing.

The share of a product in the mix is one for all sorties, so that what is left of one may stay in
the tank. On the ground a product then follows the map as the spray does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from companion.config import Config
from companion.wording import counted
from missions.demand import Rates, steps_of, valve_places
from missions.errors import PlanError
from missions.plan import Plan, Settings
from missions.sheet import filled_of

Measure = Literal["L", "kg"]
# Litres or kilograms of a product in one of its units; "/ha" is for each hectare, else each litre.
UNITS: dict[str, tuple[Measure, float]] = {
    "L/ha": ("L", 1.0), "mL/ha": ("L", 1e-3), "kg/ha": ("kg", 1.0), "g/ha": ("kg", 1e-3),
    "%": ("L", 1e-2), "L/100 L": ("L", 1e-2), "mL/100 L": ("L", 1e-5),
    "kg/100 L": ("kg", 1e-2), "g/100 L": ("kg", 1e-5),
}  # fmt: skip
# The order of mixing as the trade teaches it, W-A-L-E-S: wettable powders and granules, agitate,
# liquid flowables, emulsifiable concentrates, solutions and surfactants. Conditioners go into the
# bare water. Inside a letter: Purdue Extension, PPP-122, "Avoid Tank Mixing Errors" (2018).
STEPS: dict[str, tuple[str, ...]] = {
    "water conditioner": ("conditioner",),
    "dry, agitate until dispersed": ("SG", "SP", "WG", "WP"),
    "liquid flowable": ("SC", "CS", "ZC", "SE"),
    "emulsifiable": ("OD", "EW", "EC", "ME"),
    "solution": ("SL",),
    "surfactant or oil": ("surfactant", "oil"),
    "fertilizer": ("fertilizer",),
}
NO_STEP = "formulation not given: see its label"
_PLACES = {
    code: (number, step)
    for number, (step, code) in enumerate(
        (step, code) for step, codes in STEPS.items() for code in codes
    )
}
# ISO 16119-2: water for rinsing is a tenth of the tank, or ten times what is left in it; and what
# drains in the end holds at most 2 % of the mix. In three portions: ISO 16236.
RINSE_TIMES_LEFT, RINSE_OF_TANK, THINNED_PERCENT = 10.0, 0.1, 2.0
# A share that the record of the flight states otherwise, by more than rounding.
SAME_SHARE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownRates:
    """The rates under the passes [L/ha], where there is any: average, lowest, highest."""

    mean_l_ha: float
    low_l_ha: float
    high_l_ha: float


def flown_rates(plan: Plan, rates: Rates) -> FlownRates:
    """Return the rates under all passes of a plan, by the ground under them."""
    settings = plan.settings
    lines = np.array(
        [
            [*leg.points[0], *leg.points[-1]]
            for sortie in plan.sorties
            for leg in sortie.legs
            if leg.kind == "spray"
        ]
    )
    strips = valve_places(settings.swath_width_m, settings.valves)
    steps = steps_of(lines, len(strips))
    rate = np.concatenate([steps.rates(rates, right_m) for right_m, _ in strips])
    weight = np.concatenate([steps.long_m * strip_m for _, strip_m in strips])
    sprayed = rate > 0.0
    rate, weight = rate[sprayed], weight[sprayed]
    if not len(rate):
        raise PlanError("mix: the passes spray nothing, so there is nothing to mix")
    return FlownRates(
        mean_l_ha=float(np.average(rate, weights=weight)),
        low_l_ha=float(rate.min()),
        high_l_ha=float(rate.max()),
    )


def mix_of(
    config: Config | None, plan: Plan, rates: Rates, *, goes_on: bool = False
) -> dict[str, Any] | None:
    """Return the mix of each sortie; None where the configuration names no products.

    `goes_on` is whether a flight before this plan may have left some in the tank.
    """
    if config is None or not config.mix:
        return None
    flown = flown_rates(plan, rates)
    products = _in_order([_product(entry, flown) for entry in config.mix])
    liquid = sum(each["per_l"] for each in products if each["measure"] == "L")
    if not liquid < 1.0:
        raise PlanError(
            f"mix: the products alone come to {liquid:.3g} L for each litre to spray, at "
            f"{flown.mean_l_ha:.3g} L/ha on average; see amount, unit and at_l_ha of [[mix]]"
        )
    filled = filled_of(plan)
    adds_l = [(sortie.number, filled[sortie.number]["add_l"]) for sortie in plan.sorties]
    total_l, sprayed_l = sum(add_l for _, add_l in adds_l), sum(map(plan.needs_l, plan.sorties))
    # What is in the tank already holds the products in the same shares: it is no new mix.
    left_l = plan.settings.in_tank_l + total_l - sprayed_l
    for each in products:
        per_l = each["per_l"]
        each |= {
            "total": per_l * total_l,
            "sprayed": per_l * sprayed_l,
            "leftover": per_l * left_l,
            "per_ha_mean": per_l * flown.mean_l_ha,
            "per_ha_min": per_l * flown.low_l_ha,
            "per_ha_max": per_l * flown.high_l_ha,
        }
    return {
        "rate_mean_l_ha": flown.mean_l_ha,
        "rate_min_l_ha": flown.low_l_ha,
        "rate_max_l_ha": flown.high_l_ha,
        "products": products,
        "sorties": [
            {
                "number": number,
                "mix_l": add_l,
                "water_l": add_l * (1.0 - liquid),
                "water_first_l": add_l * (1.0 - liquid) / 2.0,
                "amounts": [each["per_l"] * add_l for each in products],
            }
            for number, add_l in adds_l
        ],
        "mix_l": total_l,
        "water_l": total_l * (1.0 - liquid),
        "leftover_l": left_l,
        "in_tank_l": plan.settings.in_tank_l,
        "rinse": _rinse(config, plan),
        "notes": [*_tank_notes(plan, goes_on=goes_on), *_notes(config, products)],
    }


def with_tank(settings: Settings, in_tank_l: float) -> Settings:
    """Return the settings with what is in the tank now; PlanError where it cannot be."""
    if in_tank_l > 0.0 and settings.aircraft > 1:
        raise PlanError("--in-tank-l is of one tank; plan for one aircraft, or empty the tanks")
    if in_tank_l > settings.tank_l:
        raise PlanError(f"--in-tank-l {in_tank_l:g}: the tank holds {settings.tank_l:g} L")
    return replace(settings, in_tank_l=in_tank_l)


def _product(entry: Any, flown: FlownRates) -> dict[str, Any]:
    """Return a product with its share in the mix: litres or kilograms in one litre."""
    measure, one = UNITS[entry.unit]
    per_l = entry.amount * one
    if entry.unit.endswith("/ha"):
        per_l /= entry.at_l_ha or flown.mean_l_ha
    return {
        "name": entry.name,
        "registration": entry.registration,
        "formulation": entry.formulation,
        "step": NO_STEP if entry.formulation is None else _PLACES[entry.formulation][1],
        "amount": entry.amount,
        "unit": entry.unit,
        "measure": measure,
        "per_l": per_l,
    }


def _in_order(products: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the products as they are mixed in; those of one kind as the file has them."""
    last = (len(_PLACES), "")
    return sorted(products, key=lambda each: _PLACES.get(each["formulation"], last)[0])


def _rinse(config: Config, plan: Plan) -> dict[str, Any]:
    """Return the clean water that one aircraft takes, and what it leaves of the mix."""
    settings, table = plan.settings, config.mission
    left_l = settings.reserve_l
    least_l = RINSE_TIMES_LEFT * left_l if left_l > 0.0 else RINSE_OF_TANK * settings.tank_l
    water_l = least_l if table is None or table.rinse_l is None else table.rinse_l
    times = 3 if table is None else table.rinses
    return {
        "times": times,
        "water_l": water_l,
        "each_l": water_l / times,
        "left_l": left_l,
        "left_percent": 100.0 * (left_l / (left_l + water_l / times)) ** times,
    }


def _tank_notes(plan: Plan, *, goes_on: bool) -> Iterator[str]:
    """Yield what the mix counts on in the tank; its shares are not measured."""
    if plan.settings.in_tank_l > 0.0:
        yield (
            f"{plan.settings.in_tank_l:g} L are in the tank before the first sortie, by "
            "--in-tank-l, and count as this same mix"
        )
    elif goes_on:
        yield "the tank counts as empty before the first sortie; what is in it: --in-tank-l"


def _notes(config: Config, products: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what a mix leaves open, or says otherwise than the rest of the configuration."""
    notes = []
    for each in products:
        meant = each["amount"] * UNITS[each["unit"]][1]
        if each["unit"].endswith("/ha") and each["per_ha_max"] > meant * (1.0 + SAME_SHARE):
            low, high = (
                amount_words(each[name], each["measure"]) for name in ("per_ha_min", "per_ha_max")
            )
            notes.append(
                f"{each['name']}: a hectare gets {low} to {high}, as the map's rates go; where "
                "the label allows no more, set at_l_ha to the highest of them"
            )
    own = config.application.product_per_l
    for each in products:
        if own is None or each["name"] != config.product.name:
            continue
        if abs(each["per_l"] - own) > SAME_SHARE * own:
            notes.append(
                f"{each['name']}: {each['per_l']:.4g} {each['measure']} in a litre of the mix, but "
                f"application.product_per_l, which the record takes, is {own:g}; correct one"
            )
    return notes


def mix_lines(mix: Mapping[str, Any]) -> list[str]:
    """Return the mix in words, a line for each product in the order of mixing."""
    products = mix["products"]
    return [
        f"mix       {mix['mix_l']:.2f} L: {mix['water_l']:.2f} L of water and "
        f"{counted(len(products), 'product')}; {mix['leftover_l']:.2f} L of it are left over",
        *(
            f"  {number}. {product_words(each)}: {amount_words(each['total'], each['measure'])}"
            for number, each in enumerate(products, start=1)
        ),
        f"rinse     {rinse_words(mix['rinse'])}",
    ]


def scale_of(largest: float, measure: Measure) -> tuple[str, float, int]:
    """Return the unit in which an amount is measured out, its factor, and the digits.

    >>> scale_of(0.25, "L"), scale_of(2.5, "kg")
    (('mL', 1000.0, 1), ('kg', 1.0, 3))
    """
    if largest < 1.0:
        return ("mL" if measure == "L" else "g"), 1000.0, 1
    return measure, 1.0, 3


def amount_words(amount: float, measure: Measure) -> str:
    """Return an amount in the unit in which it is measured out.

    >>> amount_words(0.25, "kg"), amount_words(2.5, "L")
    ('250.0 g', '2.500 L')
    """
    unit, factor, digits = scale_of(amount, measure)
    return f"{amount * factor:.{digits}f} {unit}"


def product_words(product: Mapping[str, Any]) -> str:
    """Return a product with its formulation, registration and dose."""
    told = [text for text in (product["formulation"], product["registration"]) if text]
    named = f"{product['name']} ({', '.join(told)})" if told else product["name"]
    return f"{named}, {product['amount']:g} {product['unit']}, {product['step']}"


def rinse_words(rinse: Mapping[str, Any]) -> str:
    """Return how a tank is rinsed, and how thin that makes what is left."""
    text = (
        f"{counted(rinse['times'], 'time')} with {rinse['each_l']:.2f} L of clean water for each "
        f"aircraft: thins the {rinse['left_l']:g} L left in it to {rinse['left_percent']:.2g} %"
    )
    return text if rinse["left_percent"] <= THINNED_PERCENT else f"{text}; more than 2 %, take more"

"""What lies around a plan: the ground below it, and the room beyond the ends of its passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from companion.core.frame import LocalFrame
from missions.demand import Rates
from missions.field import Field
from missions.heights import return_warnings, slowed
from missions.paced import Paced, paced
from missions.plan import Leg, Settings, Sortie, at_ferry_height
from missions.run_in import RunIn, slow_starts, with_run_ins
from missions.spacing import Spacing
from missions.speeds import Miss
from missions.stops import timed
from missions.strips import Floats
from missions.terrain import Terrain


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """The ground that is followed and the run-ins that are wanted; None is neither."""

    terrain: Terrain | None = None
    run_in: RunIn | None = None

    def check(self, field: Field, depots: Floats) -> None:
        """Refuse an elevation model that does not know all of the field and its depots."""
        if self.terrain is not None:
            self.terrain.check_field(field, depots)

    def paced(
        self, sorties: Sequence[Sortie], rates: Rates, spacing: Spacing, settings: Settings
    ) -> Paced:
        """Return the sorties with the speeds of rates and slopes, their run-ins and times."""
        found = paced(sorties, rates, settings, self.terrain)
        longer, run_in_m = found.sorties, 0.0
        if self.run_in is not None:
            longer = with_run_ins(longer, spacing.ways.field, settings, self.run_in)
            run_in_m = self.run_in.wanted_m(settings.motion.at(settings.speed_m_s))
        longer = spacing.spaced(longer)
        if self.terrain is not None:
            longer = tuple(self._slowed(sortie, settings) for sortie in longer)
        raised = at_ferry_height(longer, settings, run_in_m=run_in_m)
        return replace(found, sorties=timed(raised, settings))

    def _slowed(self, sortie: Sortie, settings: Settings) -> Sortie:
        """Return a sortie whose new ways keep to the slopes as well."""
        if self.terrain is None:
            return sortie
        legs = [
            leg if leg.kind == "spray" else slowed(leg, self.terrain, settings)
            for leg in sortie.legs
        ]
        return replace(sortie, legs=tuple(legs))

    def warnings(
        self, sorties: Sequence[Sortie], depots: Floats, frame: LocalFrame, settings: Settings
    ) -> tuple[str, ...]:
        """Return what to say of the way back over hills, and of passes without room."""
        said: tuple[str, ...] = ()
        if self.terrain is not None:
            places = [(float(east_m), float(north_m)) for east_m, north_m in depots]
            said += return_warnings(sorties, self.terrain, places, settings.height_m)
        if self.run_in is not None:
            said += slow_starts(sorties, frame, settings)
        return said


NOTHING_AROUND = Surroundings()


@dataclass(frozen=True, kw_only=True)
class Pacing:
    """Paces each sortie once: most come again when others are laid out anew or cut."""

    around: Surroundings
    rates: Rates
    spacing: Spacing
    settings: Settings
    _known: dict[tuple[Leg, ...], tuple[tuple[Leg, ...], list[Miss]]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def paced(self, sorties: Sequence[Sortie]) -> Paced:
        """Return what `Surroundings.paced` does."""
        new = [each for each in sorties if each.legs not in self._known]
        if new:
            found = self.around.paced(new, self.rates, self.spacing, self.settings)
            for given, made in zip(new, found.sorties, strict=True):
                misses = [miss for number, miss in found.misses if number == given.number]
                self._known[given.legs] = made.legs, misses
        known = [self._known[each.legs] for each in sorties]
        return Paced(
            sorties=tuple(
                replace(each, legs=legs) for each, (legs, _) in zip(sorties, known, strict=True)
            ),
            misses=tuple(
                (each.number, miss)
                for each, (_, misses) in zip(sorties, known, strict=True)
                for miss in misses
            ),
        )

"""All figures of a report, in the order of the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.report.definitions import CAUSES
from analysis.report.figures import ground, lags, over_time, spread
from analysis.report.figures.sheet import sheet_of
from analysis.report.figures.treated_map import treated_area

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.assess.assessment import Assessment
    from analysis.report.clock import Clock
    from analysis.report.figures.style import Drawn
    from analysis.report.treated import Treated


def drawn_of(assessment: Assessment, clock: Clock, treated: Treated) -> Iterator[Drawn]:
    """Yield every figure that this flight gives something to draw for."""
    flight, cells = assessment.flight, assessment.cells
    sheet = None if cells is None else sheet_of(flight, cells)
    if sheet is not None:
        yield ground.prescribed_and_applied(sheet)
        yield ground.deviation(sheet)
    yield over_time.flow_over_time(flight, _minute_zero(assessment, clock))
    tables = assessment.breakdowns
    found = [lags.lag_distances(assessment.evaluation, tables.by_rate, tables.by_speed)]
    if cells is not None:
        both = (cells.histogram_l_ha, cells.histogram_l_min)
        found.append(spread.histogram([each for each in both if each is not None]))
    by_cause = assessment.causes.by_cause
    found.append(spread.causes({CAUSES[cause.value]: area for cause, area in by_cause.items()}))
    yield from (each for each in found if each is not None)
    if sheet is not None:
        yield ground.duty(sheet)
        if not treated.area.is_empty:
            yield treated_area(sheet, treated)


def _minute_zero(assessment: Assessment, clock: Clock) -> str:
    """Return in words when the time axis begins."""
    first = clock.at(float(assessment.flight.time_s[0]))
    if first is None:
        return "the first position"
    return f"{first:%H:%M:%S} ({clock.zone_name}; {clock.source_text.split(' (')[0]})"

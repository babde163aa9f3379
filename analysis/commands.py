"""The commands of this package, as `vrspray` lists them; nothing else is imported for that."""

from companion.commands import Command

CALIBRATE = Command(
    target="analysis.calibrate_cli:app",
    help="Measure lags and flow curves; plan the flight for that.",
    haste="patient",
    hastes={"mission": "quick"},
)
REPORT = Command(
    target="analysis.report.cli:report",
    help="Evaluate a flight: page, figures, application record.",
    haste="patient",
)
REPLAY = Command(
    target="analysis.cli:replay",
    help="Replay a journal and compare every decision.",
    haste="patient",
)
EXPORT = Command(
    target="analysis.exports.cli:export",
    help="Export a flight as CSV, KML, shapefile, ISOXML and others.",
    haste="patient",
)
WSP = Command(
    target="analysis.wsp.cli:wsp",
    help="Measure coverage and drop sizes on water-sensitive paper.",
    haste="patient",
)
TRIAL = Command(
    target="analysis.trial_cli:trial",
    help="Evaluate a field trial: the plots, and yields by treatment.",
    haste="patient",
)
FLIGHTS_SHOW = Command(
    target="analysis.journals.cli:SHOW",
    help="Show what a journal records about its flight, and how much it holds.",
)
FLIGHTS_REMAINING = Command(
    target="analysis.journals.cli:REMAINING",
    help="Show what is treated, what is left in hectares and litres, and where to resume.",
)
FLIGHTS_JOB = Command(
    target="analysis.journals.cli:JOB",
    help="List the sorties of a job, for one report of all.",
)
FLIGHTS_RECOVER = Command(
    target="analysis.journals.cli:RECOVER",
    help="Repair journals after a crash or power cut.",
)
FLEET = Command(
    target="analysis.fleet.cli:app",
    help="Many journals as one data set: add, query, report, serve.",
    haste="patient",
    hastes={"serve": "at-once"},
)

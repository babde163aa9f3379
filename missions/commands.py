"""The commands of this package, as `vrspray` lists them; nothing else is imported for that."""

from companion.commands import Command

MAP = Command(
    target="missions.maps.cli.app:app",
    help="Check, show, convert, compile and make prescription maps.",
    haste="patient",
    # A flight waits for a map to be compiled.
    hastes={"rate": "quick", "new": "quick", "offset": "quick", "compile": "at-once"},
)
MAKE = Command(
    target="missions.make.cli:app",
    help="Make prescriptions from a field's data.",
    haste="patient",
)
PLAN = Command(
    target="missions.cli:app",
    help="Plan the passes over a field, sortie by sortie.",
    haste="patient",
)
UPLOAD = Command(
    target="missions.upload.cli:app", help="Upload a mission to the vehicle and verify it."
)

"""The flight map: the one file that says which rate belongs where, for the vehicle.

It is compiled in the office (`vrspray map compile`) and is all that a flight opens: the ground in
metres of the flight's frame, rates in L/ha, boundary, exclusions and planned lines, what settings
it was made with, and what was found on the way.
"""

from companion.flight_map.file import (
    JOB_KEY,
    SUFFIX,
    FlightMap,
    SourceFile,
    difference,
    frozen_settings,
    is_flight_map,
    moved,
    named_files,
    read_flight_map,
)

__all__ = [
    "JOB_KEY",
    "SUFFIX",
    "FlightMap",
    "SourceFile",
    "difference",
    "frozen_settings",
    "is_flight_map",
    "moved",
    "named_files",
    "read_flight_map",
]

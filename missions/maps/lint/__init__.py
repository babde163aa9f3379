"""What is wrong or remarkable about a map that can be read.

`read_map` refuses what cannot be used; here is what the operator should look at before a flight.
docs/reference/map-problems.md lists every code.
"""

from missions.maps.build import point_rates
from missions.maps.lint.check import check_map, summary
from missions.maps.lint.zones import Plan, Sprayer

__all__ = ["Plan", "Sprayer", "check_map", "point_rates", "summary"]

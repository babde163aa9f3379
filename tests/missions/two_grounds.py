"""Ground of maps to be written and read: a ring, and two squares as one."""

from __future__ import annotations

from shapely import MultiPolygon, box

WEST, SOUTH, CELL = 15.14, 48.12, 0.001
SQUARE = box(WEST, SOUTH, WEST + CELL, SOUTH + CELL)
RING = SQUARE.difference(SQUARE.buffer(-CELL / 4, join_style="mitre"))
NEXT = box(WEST + CELL, SOUTH, WEST + 2 * CELL, SOUTH + CELL)
TWO = MultiPolygon([NEXT, box(WEST + 3 * CELL, SOUTH, WEST + 4 * CELL, SOUTH + CELL)])

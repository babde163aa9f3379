"""The operator's page: the spraying seen, and stopped, from a phone at the field's edge.

Here is what the companion itself uses of it; the web libraries are loaded in the page's own process
only (`python -m companion.web`, started by `OperatorPage`).
"""

from __future__ import annotations

from companion.web.page import Obey, OperatorPage, Order, Outcome, listen, map_object

__all__ = ["Obey", "OperatorPage", "Order", "Outcome", "listen", "map_object"]

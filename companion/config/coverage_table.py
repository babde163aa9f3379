"""The table of treated ground: whether it is kept, and whether a valve closes over it."""

from __future__ import annotations

from pydantic import Field

from companion.config.tables import Table


class CoverageTable(Table):
    """What was treated: kept in the journal, and not sprayed twice."""

    record: bool = Field(
        default=True, description="false: the journal does not keep which ground was treated"
    )
    switch_off_percent: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description="a valve closes where so much of its strip is treated; absent: never",
    )

"""What planning refuses."""

from __future__ import annotations

from companion.errors import VrsprayError


class PlanError(VrsprayError):
    """A mission cannot be planned: the message says what, where and what to change."""

"""What planning and uploading refuse."""

from __future__ import annotations

from companion.errors import VrsprayError


class PlanError(VrsprayError):
    """A mission cannot be planned: the message says what, where and what to change."""


class OutOfReachError(PlanError):
    """No battery lasts to some place and back from any depot."""


class FenceError(PlanError):
    """No fence that the autopilot has room for holds a sortie near the field."""


class UploadError(VrsprayError):
    """A mission is not uploaded: the message says why and what to do."""

"""Closes the outputs behind the autopilot when the companion falls silent, and can do nothing else.

A process of its own, `python -P -m companion.guardian FILE`. It imports nothing of ours. All that
it ever sends is the closing order of each output, as it was told of them at its start.
"""

# For so long it closes after the companion has ended; the link stays open until then.
AFTER_S = 2.0

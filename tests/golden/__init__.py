"""Recorded flights of every kind: what the core decided then it has to decide today."""

"""A flight controller on the wire: MAVLink bytes out and in, with a twin behind its outputs.

It encodes on its own and shares nothing with `companion.link`: an error of scale made twice the
same way would cancel out. What it copies of a firmware is listed in docs/explanation/simulation.md.
"""

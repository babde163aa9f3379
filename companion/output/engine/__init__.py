"""The valve engine: a process of its own that turns plans into edges on real lines.

Read in this order: `wire` (what passes between companion and engine, the set-up first), `engine`
(one turn of the loop), `lines` (the hardware), `process` (the loop itself). `pwm` beside this
folder makes edges of plans; `closer` and `selftest` guard the rest.
"""

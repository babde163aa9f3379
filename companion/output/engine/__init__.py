"""The valve engine: a process of its own that turns plans into edges on real lines.

Read in this order: `setup` and `wiring` (what hangs on which line), `wire` (what passes between
companion and engine), `late` and `schedule` (pure: from plans to edges), `engine` (one turn of
the loop), `lines` (the hardware), `process` (the loop itself).
"""

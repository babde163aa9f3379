"""The pure core: no input, no output, no clock, no logging, no asyncio.

Read it in the order of the data: `inputs`, `types`, `setup`, `frame`; `positions`, `clock`,
`motion`, `estimator`; `safety`; `prescription`, `cells`; `braking`, `boom`, `crossings`; `nozzle`,
`schedule`; `controller`. What a flight may have and most do not is in `options`.
"""

"""The pure core: no input, no output, no clock, no logging, no asyncio.

Read it in the order of the data: `types`, `frame`, `estimator`, `boom`, `prescription`,
`crossings`, `rate`, `nozzle`, `schedule`, `interlock`, `controller`.
"""

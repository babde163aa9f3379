"""The fault campaign: `python -m tests.bench.faults --flights 200 --seed 1`.

The real `vrspray run` with its real valve engine flies short passes with the stub autopilot, in
real time; faults strike at random moments; a judge that shares no code with the core looks at what
was said on the wire and at what the outputs did.
"""

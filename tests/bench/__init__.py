"""The figures that README gives, measured: `python -m tests.bench [SEED] [--quick]`."""

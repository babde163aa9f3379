"""The figures of a report, one kind a file; every function returns a `Drawn`."""

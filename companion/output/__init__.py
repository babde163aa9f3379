"""Executors of a `SprayPlan`."""

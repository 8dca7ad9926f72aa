"""Mains of the processes that the controller starts, by name only: GMIs and probes."""

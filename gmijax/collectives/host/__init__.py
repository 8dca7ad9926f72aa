"""Exchanges through shared memory of the host."""

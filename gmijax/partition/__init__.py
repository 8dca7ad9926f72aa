"""Partition of GPUs into GMIs: layout, shares, roles, plan. Pure functions, no jax in here."""

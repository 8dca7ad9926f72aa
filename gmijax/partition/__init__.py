"""Partition of GPUs into GMIs: plan, environment, backends, supervision. No jax in here."""

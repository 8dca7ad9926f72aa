"""Collecting experience without learning: what the GMIs of `gmijax.serve` run."""

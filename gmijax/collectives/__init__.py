"""Collectives between GMIs: means of gradients and the like."""

"""Finds environments per GMI and GMIs per GPU where they are `auto` (paper, Algorithm 2)."""

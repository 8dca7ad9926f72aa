"""Proximal policy optimisation: pure update functions, and the role that runs them."""

"""Environments: tasks simulated by MuJoCo MJX, and what wraps them."""

"""Plays policies in plain MuJoCo with numpy alone: no jax, and nothing is compiled."""

"""Policies in a browser: a small simulation of a few environments, and its page. No jax here."""

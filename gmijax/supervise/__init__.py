"""Starts, watches and ends the processes of a job. No jax here."""

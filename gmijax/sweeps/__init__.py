"""Sweeps: many training jobs, several at a time on every GPU."""

"""Trained policies outside of training: loaded as a function, exported as files."""

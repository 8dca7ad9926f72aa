"""Environments of others as ours, ours as Brax's, and tasks from the user's own files."""

"""Roles of the user's own in the GMIs of a plan: any workload, not only reinforcement learning."""

"""Shared by all algorithms: policy, learner, updates, unroll, checkpoints, metrics."""

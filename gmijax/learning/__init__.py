"""What every training algorithm has: policy, learner, updates, unroll, checkpoints, metrics."""

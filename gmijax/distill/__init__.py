"""Distillation: a student learns to act as a trained policy does."""

"""Proximal policy optimisation: rollout, losses, update, and the training loop of a GMI."""

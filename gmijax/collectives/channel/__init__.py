"""Experience channels: how rollouts get from agents to trainers (paper, section 4.2)."""

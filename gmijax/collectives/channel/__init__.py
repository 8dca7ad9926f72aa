"""Experience channels: how rollouts get from agents to trainers (paper, section 4.2).

An agent sends what it has experienced in one rollout, a trainer receives batches of it. A
*piece* is the unit in which agents count: the experience of one `send`, or a part of its
environments where the whole is too large for the channel. A *transfer* is what travels: one or
more pieces.
"""

"""How far MJX-Warp and MJX-JAX are apart after some steps of a task: `steps_of_both.py TASK`.

Writes the entries of observation and reward whose difference, in the median over environments, is
more than a hundredth of their largest value. In single environments a contact or a joint's limit
may begin a step apart, with differences at once.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import jax
import numpy as np

from gmijax.sim.registry import make_env

NUM_ENVS, NUM_STEPS = 128, 3


def after_steps(task: str, impl: str) -> dict[str, Any]:
    """Observation and reward [N, ...] after steps with small random actions."""
    env = make_env(task, impl=impl, max_envs=NUM_ENVS)
    shape = (NUM_STEPS, NUM_ENVS, env.spec.action_size)
    actions = jax.random.uniform(jax.random.key(3), shape, minval=-0.25, maxval=0.25)
    keys = jax.random.split(jax.random.key(1), NUM_ENVS)
    state = jax.jit(jax.vmap(env.reset, (None, 0)))(env.model, keys)
    step = jax.jit(jax.vmap(env.step, (None, 0, 0)))
    for action in actions:
        state = step(env.model, state, action)
    return {"obs": np.asarray(state.obs), "reward": np.asarray(state.reward)[:, None]}


def main(task: str) -> None:
    """Compares both and writes a line of JSON."""
    found, wanted = after_steps(task, "warp"), after_steps(task, "jax")
    off = {}
    for name, want in wanted.items():
        scale = np.maximum(np.abs(want).max(axis=0), 1e-2)
        apart = np.abs(found[name] - want) / scale
        off[name] = np.flatnonzero(~(np.median(apart, axis=0) < 1e-2)).tolist()
    sys.stdout.write(f"{json.dumps(off)}\n")


if __name__ == "__main__":
    main(sys.argv[1])

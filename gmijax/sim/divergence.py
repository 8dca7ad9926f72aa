"""Environments whose numbers left every bound: noticed, ended, and counted.

MuJoCo in C resets an environment by itself when its state is not finite or beyond 1e10
(`mj_checkPos` and its kin); MJX does not, and one such environment in 10^8 steps would poison the
statistics and the weights of the whole job. Here such a step ends the episode with reward 0 and
the last good observation. It is counted by where the bad number was, so that a task that makes
them by mistake is not mistaken for a rare failure of the solver.
"""

from __future__ import annotations

import operator
from functools import reduce

import numpy as np

from gmijax.arrays import array_module
from gmijax.sim.interface import Env, EnvState
from gmijax.types import Array

MAX_POSITION = 1e10
"""Bound of positions, MuJoCo's own."""


def sources(term_names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of what counts bad numbers: anywhere, physics, observation, a term of the reward."""
    return ("any", "physics", "observation", *(f"reward/{name}" for name in term_names))


def diverged_by_source(env: Env, state: EnvState) -> dict[str, Array]:
    """Which of `sources` hold bad numbers: [N] bool, or [] bool for one environment in numpy."""
    xp = array_module(state.obs)

    def within(values: Array, bound: float) -> Array:
        return (abs(values) < bound).all(axis=-1)

    bad = {
        "physics": ~within(_positions(env, state), MAX_POSITION),
        "observation": ~within(state.obs, env.spec.max_abs_obs),
    }
    bad |= {f"reward/{name}": ~xp.isfinite(value) for name, value in state.reward_terms.items()}
    return bad | {"any": reduce(operator.or_, bad.values())}


def _positions(env: Env, state: EnvState) -> Array:
    if array_module(state.obs) is np:
        return env.qpos(state)
    import jax

    return jax.vmap(env.qpos)(state)


def end_diverged(before: EnvState, state: EnvState, diverged: Array) -> EnvState:
    """Ends the environments that `diverged` [N] or [] bool, with numbers that are finite."""
    xp = array_module(state.obs)

    def zero(values: Array) -> Array:
        return xp.where(diverged, 0.0, values)

    return state._replace(
        obs=xp.where(diverged[..., None], before.obs, state.obs),
        reward=zero(state.reward),
        reward_terms={name: zero(value) for name, value in state.reward_terms.items()},
        metrics={
            name: xp.where(diverged, before.metrics[name], value)
            for name, value in state.metrics.items()
        },
        terminated=state.terminated | diverged,
        truncated=state.truncated & ~diverged,
    )

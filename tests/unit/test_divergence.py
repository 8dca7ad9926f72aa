"""Worlds with bad numbers or full buffers are counted, and those with bad numbers are ended."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from toy_env import point_mass, point_mass_env

from gmijax.sim.wrappers import env_keys, training_env

ENV = point_mass()
N = 4
INIT, STEP = jax.jit(ENV.init), jax.jit(ENV.step)


def _step_from(x: list[float]):
    state = INIT(ENV.model, env_keys(jax.random.key(0), 0, N))
    position, velocity = jnp.asarray(x), state.env.physics[1]
    state = state._replace(
        env=state.env._replace(physics=(position, velocity), obs=jnp.ones((N, 2)))
    )
    return STEP(ENV.model, state, jnp.zeros((N, 1)))


def test_a_bad_world_ends_with_its_last_good_observation_and_no_reward() -> None:
    _, out = _step_from([0.0, float("nan"), 1e12, 0.5])
    np.testing.assert_array_equal(out.terminated, [False, True, True, False])
    np.testing.assert_array_equal(out.next_obs[1:3], 1.0)
    np.testing.assert_array_equal(out.reward[1:3], 0.0)
    assert np.isfinite(out.reward).all()


def test_bad_worlds_are_counted_by_where_the_number_was() -> None:
    _, out = _step_from([0.0, float("nan"), 1e7, 0.5])
    # 1e7 is a possible position, but no observation; its square is finite too.
    counts = {name: int(count) for name, count in out.diverged.items()}
    assert counts == {
        "any": 2,
        "physics": 1,
        "observation": 2,
        "reward/near": 1,
        "reward/effort": 0,
    }


def test_a_bad_world_starts_over_and_the_others_go_on() -> None:
    state, _ = _step_from([0.0, float("nan"), 0.0, 0.5])
    np.testing.assert_array_equal(state.env.steps, [1, 0, 1, 1])
    assert np.isfinite(state.env.obs).all()


def test_worlds_that_met_a_full_buffer_are_counted_by_buffer() -> None:
    def overflow(state: Any) -> jax.Array:
        return jnp.stack([jnp.ones((), bool), state.obs[0] > 0.0])

    env = training_env(point_mass_env()._replace(overflow=overflow))
    state = env.init(env.model, env_keys(jax.random.key(0), 0, N))
    _, out = env.step(env.model, state, jnp.zeros((N, 1)))
    counts = {name: int(count) for name, count in out.overflowed.items()}
    assert counts == {"contact": N, "constraint": int((out.next_obs[:, 0] > 0.0).sum())}
    assert 0 < counts["constraint"] < N
    # Without such buffers there is nothing to count.
    assert _step_from([0.0] * N)[1].overflowed == {}

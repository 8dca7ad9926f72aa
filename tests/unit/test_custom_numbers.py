"""A task of the user's own may give plain numbers: they become arrays once, in the adapter."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmijax.errors import ConfigError
from gmijax.sim.interaction import action_repeat, observation_history, time_limit
from gmijax.sim.registry import make_env
from gmijax.sim.wrappers import env_keys, training_env

TASK = """
import jax, jax.numpy as jnp, numpy as np
from gmijax.sim import episode
from gmijax.sim.interface import Env, EnvSpec

SPEC = EnvSpec("plain", 1, 1, 0.1, 4, ("near",), metrics=("far",))

def make(*, impl="auto", max_envs=None):
    def begin(model, key):
        x = jax.random.uniform(key, (1,))
        return episode.begin(SPEC, x, {TASK}, x, key)._replace(metrics={{"far": {REWARD}}})

    def step(model, state, action):
        reward = {REWARD}
        return episode.advance(
            state, state.physics, {TASK}, state.obs, (reward, {{"near": reward}}), {TERMINATED},
            metrics={{"far": {REWARD}}}, truncated={TRUNCATED},
        )

    return Env(SPEC, (), begin, step, None, lambda state: state.physics)
"""

PLAIN = {"REWARD": "1.0", "TERMINATED": "jnp.zeros((), bool)", "TRUNCATED": "None", "TASK": "()"}


def _steps(env, count: int):
    batched = training_env(env)
    state = jax.jit(batched.init)(env.model, env_keys(jax.random.key(0), 0, 2))
    step = jax.jit(batched.step)
    ends = []
    for _ in range(count):
        state, out = step(env.model, state, jnp.zeros((2, 1)))
        ends.append((out.terminated, out.truncated))
    return np.array(jax.tree.map(np.asarray, ends)).swapaxes(0, 1), out


@pytest.mark.parametrize(
    "given",
    [
        {"TERMINATED": "False"},
        {"TERMINATED": "np.bool_(False)"},
        {"TERMINATED": "0"},
        {"TRUNCATED": "False"},
        {"REWARD": "1"},
        {"REWARD": "np.float64(1.0)"},
        {"TASK": "0"},
        {"TERMINATED": "False", "REWARD": "1", "TASK": "(0, 1.5, True)"},
    ],
)
@pytest.mark.parametrize(("repeat", "history"), [(1, 1), (2, 3)])
def test_plain_numbers_end_episodes_as_arrays_do(given, repeat: int, history: int, tmp_path: Path):
    file = tmp_path / "task.py"
    file.write_text(TASK.format(**{**PLAIN, **given}))
    env = time_limit(make_env(f"{file}:make", suite="custom"), 4)
    env = observation_history(action_repeat(env, repeat), history)
    (terminated, truncated), out = _steps(env, 5)
    assert terminated.dtype == truncated.dtype == bool
    assert not terminated.any()
    assert truncated[:, 0].tolist() == [(n + 1) * repeat % 4 == 0 for n in range(5)]
    assert out.reward.dtype == jnp.float32
    np.testing.assert_array_equal(out.reward, repeat)


def test_true_ends_every_episode_at_once(tmp_path: Path):
    file = tmp_path / "task.py"
    file.write_text(TASK.format(**{**PLAIN, "TERMINATED": "True"}))
    (terminated, truncated), _ = _steps(make_env(f"{file}:make", suite="custom"), 3)
    assert terminated.all()
    assert not truncated.any()


def test_an_array_of_another_dtype_is_still_refused(tmp_path: Path):
    file = tmp_path / "task.py"
    file.write_text(TASK.format(**{**PLAIN, "REWARD": "jnp.ones((), int)"}))
    with pytest.raises(ConfigError, match="far is int32"):
        make_env(f"{file}:make", suite="custom")

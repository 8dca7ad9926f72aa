"""Environments at their starts: none of more memory than there is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import walker

from gmijax.errors import ConfigError
from gmijax.learning import memory, start
from gmijax.machine.host_limits import HostLimits
from gmijax.sim.wrappers import BatchState, env_keys, training_env

KEY = jax.random.key(3)
ENV = training_env(walker(5))


def begin(num_envs: int, kept_steps: int = 4) -> BatchState:
    return start.begin_episodes(ENV, KEY, 7, num_envs, kept_steps=kept_steps)


def test_episodes_begin_with_the_keys_of_their_environments():
    expected = jax.jit(ENV.init)(ENV.model, env_keys(KEY, 7, 3))
    jax.tree.map(np.testing.assert_array_equal, data(begin(3)), data(expected))


def test_more_environments_than_memory_holds_are_refused_before_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
):
    def made(*_: object) -> None:
        raise AssertionError("made keys of all of them")

    monkeypatch.setattr(start, "env_keys", made)
    with pytest.raises(ConfigError, match=r"num_envs=10000000000: a GMI would need more than "):
        begin(10**10)


def test_what_fits_is_named_and_is_taken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "detect_host", lambda: HostLimits(memory_mib=1))
    with pytest.raises(ConfigError, match=r"allowed: .*num_envs less than") as refused:
        begin(10**6)
    most = int(str(refused.value).rpartition(" ")[2])
    begin(most - 1)
    with pytest.raises(ConfigError, match=f"num_envs={most + 1}"):
        begin(most + 1)
    with pytest.raises(ConfigError, match=r"8 steps of each .* unroll_length up to [4-7], or"):
        begin(most - 1, kept_steps=8)
    with pytest.raises(ConfigError, match="for those of 2 runs and 4 steps of each"):
        start.begin_episodes(ENV, KEY, 7, most - 1, kept_steps=4, num_runs=2)
    with pytest.raises(ConfigError, match=r"allowed: unroll_length up to \d+$"):
        begin(8, kept_steps=10**9)  # Not even one environment could have so many.
    with pytest.raises(ConfigError, match="allowed: less of both num_envs and unroll_length"):
        begin(10**6, kept_steps=10**9)
    monkeypatch.setattr(memory, "detect_host", HostLimits)  # Unknown.
    begin(most + 1)


def data(state: object) -> object:
    return jax.tree.map(
        lambda leaf: (
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        ),
        state,
    )

"""The programs that `benchmarks.off_policy` times in a GMI: SAC's own, together and apart."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax

import gmijax
from gmijax.collectives.program import LocalCollectives
from gmijax.config import SacConfig
from gmijax.learning.learner import make_learner
from gmijax.learning.start import first_envs
from gmijax.sac.replay import Replay
from gmijax.sac.sac import iterate, step_into_replay
from gmijax.sac.state import Memory, SacState, begin, init
from gmijax.sac.updates import update_critics, update_policy
from gmijax.types import PRNGKey
from gmijax.workers.training_worker import environments


class Programs:
    """One GMI's environments, learner and full replay; each method is a whole iteration.

    An iteration has T rounds. A method returns when the device is done.

    Args:
      overrides: of a training with `algo=sac`.
    """

    def __init__(self, overrides: tuple[str, ...]) -> None:
        config = gmijax.compose(*overrides)
        assert isinstance(config.algo, SacConfig)
        self._config, self._env = config.algo, environments(config, 0)
        self._learner = make_learner(self._env.spec, config.algo)
        obs_size = self._env.spec.obs_size
        self._state: SacState = jax.jit(partial(init, self._learner, obs_size))(jax.random.key(0))
        envs = first_envs(self._env, config, 0)
        self._memory: Memory = jax.jit(partial(begin, self._learner, self._env))(envs)
        self._both = jax.jit(self._iterate, donate_argnums=(0, 1))
        self._act = jax.jit(self._step, donate_argnums=1)
        self._learn = jax.jit(self._update, donate_argnums=0)
        # Units of a replay in half precision are there after the first iteration.
        self.both()
        for _ in range(config.algo.replay_steps // config.algo.unroll_length):
            self.act()

    def both(self) -> None:
        """Agents and learner in turn."""
        self._state, self._memory = self._both(self._state, self._memory)
        jax.block_until_ready(self._state)

    def act(self) -> None:
        """The steps alone."""
        self._memory = self._act(self._state, self._memory)
        jax.block_until_ready(self._memory)

    def learn(self) -> None:
        """The updates alone."""
        self._state = self._learn(self._state, self._memory.replay, jax.random.key(1))
        jax.block_until_ready(self._state)

    def _iterate(self, state: SacState, memory: Memory) -> tuple[SacState, Memory]:
        env, learner = self._env, self._learner
        return iterate(env, learner, LocalCollectives(), env.model, state, memory)[:2]

    def _step(self, state: SacState, memory: Memory) -> Memory:
        def once(memory: Memory, _: None) -> tuple[Memory, Any]:
            return step_into_replay(self._env, self._learner, self._env.model, state, memory)

        return jax.lax.scan(once, memory, length=self._config.unroll_length)[0]

    def _update(self, state: SacState, replay: Replay, key: PRNGKey) -> SacState:
        local = self._learner, LocalCollectives(), replay

        def turn(state: SacState, keys: PRNGKey) -> tuple[SacState, Any]:
            state, figures = jax.lax.scan(partial(update_critics, *local), state, keys[1:])
            state, loss = update_policy(*local, state, keys[0])
            return state, (figures, loss)

        every = self._config.policy_every
        turns = self._config.unroll_length * self._config.updates_per_step // every
        return jax.lax.scan(turn, state, jax.random.split(key, (turns, every + 1)))[0]

"""The programs that `benchmarks.off_policy` times in a GMI: SAC's own, together and apart."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax

import gmijax
from gmijax.collectives.program import LocalCollectives
from gmijax.config import SacConfig
from gmijax.learning.learner import finish_iteration, make_learner
from gmijax.learning.start import first_envs
from gmijax.learning.unroll import RolloutSums, merge_sums
from gmijax.sac.replay import Replay, can_learn
from gmijax.sac.sac import iterate, learn_after_turn, learn_in_round, step_into_replay
from gmijax.sac.state import Memory, SacState, begin, init
from gmijax.sac.updates import SacLosses, UpdateFigures, losses_of
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
        self._act = jax.jit(self._steps, donate_argnums=1)
        self._learn = jax.jit(self._updates, donate_argnums=0)
        self.both()  # The statistics of observations.
        for _ in range(-(-config.algo.replay_steps // config.algo.unroll_length)):
            self.act()
        replay = self._memory.replay
        assert int(replay.filled) == config.algo.replay_steps
        assert can_learn(replay, config.algo.learning_starts)

    def both(self) -> None:
        """Agents and learner in turn."""
        self._state, self._memory, metrics = self._both(self._state, self._memory)
        jax.block_until_ready((self._state, metrics))

    def act(self) -> None:
        """The steps alone, and what an iteration sums of them."""
        self._memory, self._sums = self._act(self._state, self._memory)
        jax.block_until_ready((self._memory, self._sums))

    def learn(self) -> None:
        """The updates alone, with the latest statistics."""
        self._state, losses = self._learn(self._state, self._memory.replay, self._sums)
        jax.block_until_ready((self._state, losses))

    def _iterate(self, state: SacState, memory: Memory) -> tuple[SacState, Memory, Any]:
        env, learner = self._env, self._learner
        return iterate(env, learner, LocalCollectives(), env.model, state, memory)

    def _steps(self, state: SacState, memory: Memory) -> tuple[Memory, RolloutSums]:
        def once(memory: Memory, _: None) -> tuple[Memory, RolloutSums]:
            return step_into_replay(self._env, self._learner, self._env.model, state, memory)

        memory, sums = jax.lax.scan(once, memory, length=self._config.unroll_length)
        return memory, merge_sums(sums)

    def _updates(
        self, state: SacState, replay: Replay, sums: RolloutSums
    ) -> tuple[SacState, SacLosses]:
        local = self._learner, LocalCollectives(), replay

        def turn(state: SacState, keys: PRNGKey) -> tuple[SacState, UpdateFigures]:
            state, figures = jax.lax.scan(partial(learn_in_round, *local), state, keys[1:])
            return learn_after_turn(*local, state, figures, keys[0])

        length = self._config.rounds_per_turn
        key = jax.random.fold_in(state.key, state.updates)
        keys = jax.random.split(key, (self._config.unroll_length // length, length + 1))
        state, figures = jax.lax.scan(turn, state, keys)
        return finish_iteration(self._learner, state, sums.obs), losses_of(figures)

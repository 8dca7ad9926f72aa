"""What a vector environment of another library runs: a reset and a step, compiled once each."""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.sim.interface import Env
from gmijax.sim.wrappers import BatchedEnv, BatchState, select_envs, training_env
from gmijax.types import Array, PRNGKey, PyTree

Autoreset: TypeAlias = Literal["same_step", "next_step", "disabled"]
"""When an environment that has ended starts over: in the step that ended it, in the next step,
whose action does nothing there, or when `reset` is called for it."""


class VectorOutcome(NamedTuple):
    """What one step of N environments is for the caller.

    Attributes:
      obs: [N, O] float32, what to act on next.
      reward: [N] float32.
      terminated: [N] bool, the task has ended.
      truncated: [N] bool, time ran out.
      is_diverged: [N] bool, the environment was ended because of a bad number; it is terminated.
      final_obs: [N, O] float32, what the action led to, before any reset.
      episode_return: [N] float32, sum of the rewards of the episode with this step.
      episode_length: [N] int32, its steps.
    """

    obs: Array
    reward: Array
    terminated: Array
    truncated: Array
    is_diverged: Array
    final_obs: Array
    episode_return: Array
    episode_length: Array


class VectorPrograms:
    """N environments as two compiled programs. Their states are on `device`, and stay there.

    Args:
      env: one environment with a time limit.
      autoreset: see `Autoreset`.
      random_ep_len: whether `BatchState.head_start` shortens first episodes.
    """

    def __init__(self, env: Env, autoreset: Autoreset, *, random_ep_len: bool = False) -> None:
        batched = training_env(env, random_ep_len=random_ep_len)
        self.device = jnp.zeros(()).device
        self._model = jax.device_put(env.model, self.device)
        self._init = jax.jit(batched.init)
        self._select = jax.jit(select_envs)
        step = _same_step if autoreset == "same_step" else _held
        self._step = jax.jit(
            lambda model, state, actions: step(batched, autoreset, model, state, actions)
        )

    def start(self, keys: PRNGKey) -> BatchState:
        """New episodes in all environments, from keys [N]."""
        state = self._init(self._model, keys)
        # Without a head start; the user may set one.
        state = state._replace(head_start=jnp.zeros_like(state.head_start))
        # Committed to the device, as what a step returns: else the second step would compile anew.
        return jax.device_put(state, self.device)

    def start_some(self, state: BatchState, keys: PRNGKey, chosen: Array) -> BatchState:
        """New episodes in the environments that are `chosen` [N] bool."""
        chosen = jax.device_put(chosen, self.device)
        return self._select(chosen, self.start(keys), state)

    def step(self, state: BatchState, actions: Array) -> tuple[BatchState, VectorOutcome]:
        """One control step under actions [N, A]."""
        return self._step(self._model, state, jax.device_put(actions, self.device))


def _same_step(
    batched: BatchedEnv, _: Autoreset, model: PyTree, state: BatchState, actions: Array
) -> tuple[BatchState, VectorOutcome]:
    after, out = batched.step(model, state, actions)
    return after, VectorOutcome(
        obs=after.env.obs,
        reward=out.reward,
        terminated=out.terminated,
        truncated=out.truncated,
        is_diverged=out.is_diverged,
        final_obs=out.next_obs,
        episode_return=state.return_sum + out.reward,
        episode_length=state.env.steps + 1,
    )


def _held(
    batched: BatchedEnv, autoreset: Autoreset, model: PyTree, state: BatchState, actions: Array
) -> tuple[BatchState, VectorOutcome]:
    """Environments that had ended before this step are not stepped: they start over, or stay."""
    had_ended = state.env.terminated | state.env.truncated
    stepped, out = batched.advance(model, state, actions)
    held = state if autoreset == "disabled" else batched.restart(model, state)
    after = select_envs(had_ended, held, stepped)
    return after, VectorOutcome(
        obs=after.env.obs,
        reward=jnp.where(had_ended, 0.0, out.reward),
        terminated=after.env.terminated,
        truncated=after.env.truncated,
        is_diverged=out.is_diverged & ~had_ended,
        final_obs=after.env.obs,
        episode_return=jnp.where(had_ended, 0.0, state.return_sum + out.reward),
        episode_length=after.env.steps,
    )

"""SAC with agents and learner in different GMIs.

For every unroll that arrives, the learner makes as many updates as it would have made while it
stepped the environments itself: `updates_per_step` for each of its T steps. So it waits for
experience, and an agent that is ahead waits for room: the ratio is that of one program. What
differs is the age of the policy that acts.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Collectives, Communicator
from gmijax.compile_once import compile_once
from gmijax.config import SacConfig
from gmijax.decoupled.algorithm import DecoupledAlgorithm, Flow, UpdateResult
from gmijax.learning.learner import (
    ActingWeights,
    acting_moments,
    acting_weights,
    finish_iteration,
    pack_weights,
)
from gmijax.learning.normalize import Moments, merge_all
from gmijax.learning.policy import ActorCritic
from gmijax.learning.unroll import Counts, Outcome, act, count, outcome_of, unroll
from gmijax.sac.replay import CUT, TERMINATED, Replay, empty_replay, kind_of
from gmijax.sac.sac import SAC as IN_TURN
from gmijax.sac.sac import figures_of, rounds, take_in
from gmijax.sac.state import SacLearner, SacState
from gmijax.sac.updates import losses_of
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree

_MAX_AHEAD = 2
"""Unrolls that wait for the learner: one that it takes next, so that it need not wait, and one on
its way. More would only be older."""


class Steps(NamedTuple):
    """Unrolls of N environments, of T steps; fields are the channels they travel in.

    Attributes:
      obs: [T, N, O], raw.
      action: [T, N, A], as the environment got it.
      reward: [T, N], unscaled.
      ends: [T, N, 2] bool: whether the kind of a step is `TERMINATED`, and whether it is `CUT`.
    """

    obs: Array
    action: Array
    reward: Array
    ends: Array


class Arrived(NamedTuple):
    """The replay with an unroll that has just arrived, and the statistics of that."""

    replay: Replay
    seen: Moments


def collect(
    env: BatchedEnv,
    networks: ActorCritic,
    num_steps: int,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Steps, Counts]:
    """See `gmijax.decoupled.algorithm.Collect`."""

    def keep(
        before: BatchState, drawn: Any, action: Array, out: StepOutput
    ) -> tuple[Steps, Outcome]:
        del drawn
        kind = kind_of(out.terminated, out.truncated, out.is_diverged)
        ends = jnp.stack([kind == TERMINATED, kind == CUT], axis=-1)
        return Steps(before.env.obs, action, out.reward, ends), outcome_of(out)

    choose = partial(act, networks, weights)
    env_state, (kept, outcomes) = unroll(env, choose, num_steps, keep, model, env_state)
    return env_state, kept, count(kept.reward, outcomes)


def arrive(learner: SacLearner, replay: Replay, state: SacState, steps: Steps) -> Arrived:
    """Takes an unroll into the replay."""
    kind = kind_of(steps.ends[..., 0], steps.ends[..., 1], jnp.zeros((), bool))
    known = acting_moments(learner.config, state)
    return Arrived(*take_in(replay, known, steps.obs, steps.action, steps.reward, kind))


def learn(
    learner: SacLearner, collectives: Collectives, _: Any, before: SacState, arrived: Arrived
) -> tuple[SacState, Arrived, UpdateResult]:
    """All updates after an unroll, as a `gmijax.collectives.interface.Step`."""
    state, arrived, (_, updates) = rounds(
        learner, collectives, lambda _, memory: (memory, ()), before, arrived
    )
    seen = merge_all(collectives.all_gather(arrived.seen, after=updates))
    state = finish_iteration(learner, state, seen)
    num_updates = (state.updates - before.updates).astype(jnp.float32)
    figures = figures_of(state, arrived.replay) | {
        "async/updates_per_step": num_updates / learner.config.unroll_length
    }
    weights = pack_weights(acting_weights(learner, state))
    return state, arrived, UpdateResult(weights, losses_of(updates), {}, figures)


class SacUpdate:
    """The update of the learner, with its replay: `gmijax.decoupled.algorithm.Update`."""

    def __init__(
        self, learner: SacLearner, spec: EnvSpec, num_envs: int, comm: Communicator
    ) -> None:
        config = learner.config
        self._arrive: Any = jax.jit(partial(arrive, learner), donate_argnums=(0,))
        self._learn = comm.program(partial(learn, learner))
        self._example = _example(config, spec, num_envs)
        dtype = jnp.dtype(config.replay_precision)
        self._replay = empty_replay(spec, config.replay_steps, num_envs, dtype)

    def compile(self, state: SacState) -> None:
        """See `Update`."""
        lowered = self._arrive.lower(self._replay, state, self._example)
        self._learn.trace((), state, lowered.out_info)
        self._arrive = compile_once(lowered)
        self._learn.compile()

    def __call__(
        self, state: SacState, experience: Mapping[str, Any], weight: Any
    ) -> tuple[SacState, UpdateResult]:
        """See `Update`; every unroll is learnt from."""
        del weight
        arrived = self._arrive(self._replay, state, Steps(**experience))
        state, arrived, updated = self._learn(state, arrived)
        self._replay = arrived.replay
        return state, updated

    def wait(self) -> None:
        """See `Update`."""
        self._learn.wait()


def _example(config: SacConfig, spec: EnvSpec, num_envs: int) -> Any:
    """Shapes of what an agent sends."""
    rows = config.unroll_length, num_envs

    def floats(*shape: int) -> Any:
        return jax.ShapeDtypeStruct((*rows, *shape), jnp.float32)

    ends: Any = jax.ShapeDtypeStruct((*rows, 2), jnp.bool_)
    return Steps(floats(spec.obs_size), floats(spec.action_size), floats(), ends)


SAC = DecoupledAlgorithm(
    init=IN_TURN.init,
    learned=IN_TURN.learned,
    flow=lambda _, num_envs: Flow(num_envs, 1, _MAX_AHEAD, None),
    collect=collect,
    make_update=SacUpdate,
    num_averaged=IN_TURN.num_averaged,
)

"""What an algorithm is to the training loop (`gmijax.learning.loop`).

In a job all GMIs of which simulate, act and train, an algorithm is one function: an iteration. The
loop compiles it and has all else: clock, metrics, evaluations, checkpoints, the end. `docs/
extending.md` has the steps that add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax

from gmijax.collectives.interface import Collectives
from gmijax.config import AlgoConfig
from gmijax.learning.learner import Learner
from gmijax.learning.unroll import Counts
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PRNGKey, PyTree


class Losses(Protocol):
    """Parts of a loss, means over a minibatch: a named tuple of [] float32."""

    def _asdict(self) -> dict[str, Any]: ...


class IterationMetrics(NamedTuple):
    """Figures of one iteration, over all GMIs; leaves are scalars.

    No two of them may be the same number by definition: a GPU's program writes one of these to
    the host and copies it there to the other, for which the host waits until all else is done.

    Attributes:
      counts: sums over all steps.
      losses: means over all minibatches of the iteration.
      figures: others by the names that they are logged under.
      rates: of the learning rates of all updates, see `rate_figures`.
    """

    counts: Counts
    losses: Losses
    figures: dict[str, Array]
    rates: dict[str, Array]


Iterate: TypeAlias = Callable[
    [BatchedEnv, Any, Collectives, PyTree, Any, Any], tuple[Any, Any, IterationMetrics]
]
"""`(env, learner, collectives, model, state, memory) -> (state, memory, metrics)`: a rollout and
its updates, a pure function. State and memory are donated. `state` is a named tuple with at least
the fields of a `TrainState` that acting needs, and comes out equal on all GMIs, since what goes
into it passes through `collectives`. `memory` is a GMI's own."""


@dataclass(frozen=True)
class Algorithm:
    """An algorithm for jobs in which every GMI simulates, acts and trains.

    Attributes:
      make_learner: networks, optimiser and hyper-parameters for the sizes of an environment.
      init: `(learner, obs_size, key)` to the first state.
      iterate: see `Iterate`.
      num_averaged: how many float32 GMIs average in one update, at most: gradient and parts of the
        loss.
      begin: `(learner, env, environments at their starts)` to the first memory of a GMI; by
        default the environments.
      envs: the environments in a memory, which checkpoints hold.
      replay: `(learner, memory)` to the experience that checkpoints hold too, None: none.
      with_replay: `(memory, experience)` to the memory with that of a checkpoint.
      learned: all weights in a state, which have to be finite, and equal on all GMIs.
    """

    make_learner: Callable[[EnvSpec, Any], Learner[Any]]
    init: Callable[[Learner[Any], int, PRNGKey], Any]
    iterate: Iterate
    num_averaged: Callable[[EnvSpec, Any], int]
    begin: Callable[[Learner[Any], BatchedEnv, BatchState], Any] = lambda _, __, envs: envs
    envs: Callable[[Any], BatchState] = lambda memory: memory
    replay: Callable[[Learner[Any], Any], PyTree | None] = lambda _, __: None
    with_replay: Callable[[Any, PyTree], Any] = lambda memory, _: memory
    learned: Callable[[Any], PyTree] = lambda state: state.params


def load_algorithm(config: AlgoConfig) -> Algorithm:
    """The algorithm that a configuration is of; see `PolicyConfig.implementation`."""
    module, name = config.implementation.split(":")
    return getattr(import_module(module), name)


def iterate_all(
    iterate: Iterate,
    env: BatchedEnv,
    learner: Learner[Any],
    collectives: Collectives,
    model: PyTree,
    states: Any,
    memories: Any,
) -> tuple[Any, Any, IterationMetrics]:
    """An iteration of several runs; states, memories and metrics have a leading axis [K]."""
    return jax.vmap(lambda *own: iterate(env, learner, collectives, model, *own))(states, memories)

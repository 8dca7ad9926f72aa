"""What an algorithm is to agents and trainers in different GMIs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, Protocol, TypeAlias

from gmijax.collectives.interface import Communicator
from gmijax.config import AlgoConfig
from gmijax.decoupled.unrolls import concatenated
from gmijax.learning.algorithm import Losses
from gmijax.learning.learner import ActingWeights, Learner
from gmijax.learning.policy import ActorCritic
from gmijax.learning.unroll import Counts
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PRNGKey, PyTree


class Flow(NamedTuple):
    """How much experience goes from agents to trainers at once.

    Attributes:
      batch_unrolls: B, unrolls of one environment each in a batch of one trainer.
      pieces: of equal length that an unroll is made in, each with the newest weights.
      max_ahead: unrolls of an agent that may wait for every trainer before it waits too.
      max_staleness: unrolls of a policy that is more versions behind are not learnt from; None:
        all are.
    """

    batch_unrolls: int
    pieces: int
    max_ahead: int
    max_staleness: int | None


class UpdateResult(NamedTuple):
    """Results of an update, beside the state.

    Attributes:
      weights: [W] float32, to publish; see `pack_weights`.
      losses: means over all minibatches of all trainers, [] each.
      rates: of all minibatches, see `rate_figures`.
      figures: others by the names that they are logged under, [] each.
    """

    weights: Array
    losses: Losses
    rates: dict[str, Array]
    figures: dict[str, Array]


class Update(Protocol):
    """What a trainer does with a batch, and what it keeps from one to the next."""

    def compile(self, state: Any) -> None:
        """Makes its programs; `state` is an example."""
        ...

    def __call__(
        self, state: Any, experience: Mapping[str, Any], weight: Any
    ) -> tuple[Any, UpdateResult]:
        """The state after a batch, which makes a new version of the policy; `state` is donated.

        Args:
          state: of the learner.
          experience: arrays by channel, [S, B, ...].
          weight: [B] float32, 0 for unrolls that are too old to learn from.
        """
        ...

    def wait(self) -> None:
        """Returns when the last call is computed; see `TracedStep`."""
        ...


Collect: TypeAlias = Callable[
    [BatchedEnv, ActorCritic, int, PyTree, ActingWeights, BatchState],
    tuple[BatchState, Any, Counts],
]
"""`(env, networks, num_steps, model, weights, env_state) -> (env_state, experience, counts)`: an
unroll, or a piece of one, with one version of the policy. The experience is a named tuple of
channels [S, N, ...]; `reward` [S, N] is one of them."""


@dataclass(frozen=True)
class DecoupledAlgorithm:
    """An algorithm for jobs in which agents and trainers are different GMIs.

    Attributes:
      init: `(learner, obs_size, key)` to the first state.
      learned: all weights in a state, which have to be finite, and equal on all trainers.
      flow: of a configuration and environments of an agent.
      collect: see `Collect`.
      make_update: `(learner, spec, environments of an agent, communicator)` to a trainer's update.
      num_averaged: see `gmijax.learning.algorithm.Algorithm`.
      join: pieces of an unroll, in a row, to the whole.
    """

    init: Callable[[Learner[Any], int, PRNGKey], Any]
    learned: Callable[[Any], PyTree]
    flow: Callable[[Any, int], Flow]
    collect: Collect
    make_update: Callable[[Learner[Any], EnvSpec, int, Communicator], Update]
    num_averaged: Callable[[EnvSpec, Any], int]
    join: Callable[[Sequence[Any]], Any] = concatenated


def load_decoupled(config: AlgoConfig) -> DecoupledAlgorithm:
    """The algorithm that a configuration is of; see `PolicyConfig.decoupled`."""
    module, name = config.decoupled.split(":")
    return getattr(import_module(module), name)

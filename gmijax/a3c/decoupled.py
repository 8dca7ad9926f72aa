"""A3C as agents and trainers in different GMIs see it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.a3c.a3c import A3cLosses, make_update
from gmijax.a3c.rollout import collect, join
from gmijax.a3c.targets import A3cLearner, Unrolls
from gmijax.collectives.interface import Communicator
from gmijax.config import A3cConfig
from gmijax.decoupled.algorithm import DecoupledAlgorithm, Flow, UpdateResult
from gmijax.learning.learner import TrainState, init_learner
from gmijax.learning.updates import exchange_size
from gmijax.sim.interface import EnvSpec


class A3cUpdate:
    """The update of a trainer: `gmijax.decoupled.algorithm.Update`."""

    def __init__(
        self, learner: A3cLearner, spec: EnvSpec, num_envs: int, comm: Communicator
    ) -> None:
        self._program = make_update(learner, comm)
        self._example = _example(learner.config, spec, num_envs)

    def compile(self, state: TrainState) -> None:
        """See `Update`."""
        self._program.trace((), state, self._example)
        self._program.compile()

    def __call__(
        self, state: TrainState, experience: Mapping[str, Any], weight: Any
    ) -> tuple[TrainState, UpdateResult]:
        """See `Update`."""
        state, _, updated = self._program(state, (Unrolls(**experience), weight))
        return state, updated

    def wait(self) -> None:
        """See `Update`."""
        self._program.wait()


def _example(config: A3cConfig, spec: EnvSpec, num_envs: int) -> tuple[Unrolls, Any]:
    """Shapes of a batch and its weights."""
    steps, size = config.unroll_length, config.batch_of(num_envs)

    def floats(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    unrolls = Unrolls(
        state=floats(steps, size, spec.obs_size),
        action=floats(steps, size, spec.action_size),
        reward=floats(steps, size),
        done=jax.ShapeDtypeStruct((steps, size, 2), jnp.bool_),  # pyright: ignore[reportArgumentType]
        log_prob=floats(steps, size),
        cut_value=floats(steps, size),
        bootstrap=floats(1, size, spec.obs_size),
    )
    return unrolls, floats(size)


def _flow(config: A3cConfig, num_envs: int) -> Flow:
    pieces = config.pieces_per_unroll
    return Flow(config.batch_of(num_envs), pieces, config.max_ahead, config.max_staleness)


A3C = DecoupledAlgorithm(
    init=init_learner,
    learned=lambda state: state.params,
    flow=_flow,
    collect=collect,
    make_update=A3cUpdate,
    num_averaged=partial(exchange_size, losses=A3cLosses),
    join=join,
)

"""A task with its compiled programs, which all contract tests of one pytest process share."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import jax
import mujoco

from gmijax.sim import physics, simulators
from gmijax.sim.registry import make_env
from gmijax.sim.wrappers import BatchState, StepOutput, env_keys, training_env

T = TypeVar("T")

NUM_ENVS = 8
EPISODE_LENGTH = 25
NUM_STARTS = 4
"""Environments that `converged_step` is called with: it is compiled once."""


def on_device(state: T) -> T:
    """Says where it is, as what a step returns does: or a second step would compile it again.

    MJX puts a model on a device by name, which is handed on to whatever is computed with it.
    """
    return jax.device_put(state, jax.devices()[0])


class CompiledTask:
    """One task with one MJX implementation; `traces` grows by one whenever step is traced."""

    def __init__(self, name: str, impl: str) -> None:
        self.impl = impl
        self.env = make_env(name, impl=impl, episode_length=EPISODE_LENGTH, max_envs=NUM_ENVS)
        self.batch = training_env(self.env)
        self.traces: list[int] = []
        self.init: Callable[[Any, jax.Array], BatchState] = jax.jit(self.batch.init)
        self.step: Callable[[Any, BatchState, jax.Array], tuple[BatchState, StepOutput]] = jax.jit(
            self._counted
        )

    def _counted(self, model: Any, state: BatchState, actions: jax.Array) -> Any:
        self.traces.append(1)
        return self.batch.step(model, state, actions)

    def start(self, seed: int = 0) -> BatchState:
        return on_device(self.init(self.env.model, env_keys(jax.random.key(seed), 0, NUM_ENVS)))

    def actions(self, seed: int) -> jax.Array:
        shape = (NUM_ENVS, self.env.spec.action_size)
        return jax.random.uniform(jax.random.key(seed), shape, minval=-1.0, maxval=1.0)

    @cached_property
    def converged(self) -> physics.Physics:
        """The physics with solvers that run to the end.

        Cut off early, as in training, they stop at different places on the way to one answer.
        """
        mj_model = simulators.load(self.env.spec.name, impl="jax", substeps=1).mj_model
        mj_model.opt.iterations = mj_model.opt.ls_iterations = 50
        return physics.from_mj_model(mj_model, impl=self.impl, substeps=1, max_envs=NUM_STARTS)

    @cached_property
    def converged_step(
        self,
    ) -> Callable[..., tuple[physics.PhysicsState, jax.Array]]:
        """`(model, state, ctrl) -> (state, sensordata)` of NUM_STARTS `converged` environments."""
        return jax.jit(jax.vmap(self.converged.step, in_axes=(None, 0, 0)))

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.env.mj_model

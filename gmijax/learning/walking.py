"""Records the walking test in MJX: any policy in one of Playground's joystick tasks.

Each environment has one start, which no training has, and is never reset. The results for the
policy are computed from the recording by `gmijax.player.walking`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.compile_once import compile_once
from gmijax.config import EnvConfig
from gmijax.errors import ConfigError
from gmijax.learning.learner import Learner, acting_weights
from gmijax.learning.memory import require_memory
from gmijax.learning.normalize import normalize
from gmijax.player.joystick import Ground, Readings, Robot, with_pushes
from gmijax.player.walking import LENGTH_S, ONE_ACTION, Recording, Walk, measure
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.randomize import make_envs
from gmijax.sim.wrappers import env_keys, select_envs, vectorise
from gmijax.types import Array, PyTree

FIRST_ENV = 3 * 2**29
"""Number of the test's first environment: no training has as many, evaluations begin at 2^30."""

CHUNK_STEPS = 50
"""Steps of the compiled program."""

Act: TypeAlias = Callable[[PyTree, Array], Array]
"""`(weights, obs [N, O]) -> actions [N, A]`, without noise. Observations are those of the `Env`:
of Playground's, `state` and behind it `privileged_state`."""


class WalkingTest:
    """The test's programs, made once for weights of the same shapes.

    Args:
      env: one environment, with pushes on, and as trained else.
      robot: whose task it is.
      act: the policy, see `Act`.
      num_envs: N.
      seed: of the environments' starts, commands and pushes.
      length_s: seconds that each is watched for.
    """

    def __init__(
        self,
        env: Env,
        robot: Robot,
        act: Act,
        *,
        num_envs: int,
        seed: int,
        length_s: float = LENGTH_S,
    ) -> None:
        self._env, self._robot = env, robot
        self._num_steps = round(length_s / env.spec.control_dt_s)
        self._keys = env_keys(jax.random.key(seed), FIRST_ENV, num_envs)
        batched, readings = vectorise(env), Readings(env.mj_model, robot)
        self._begin: Any = jax.jit(batched.reset)
        self._chunk: Any = jax.jit(partial(_run_chunk, batched, readings, act))
        self.compile_s = 0.0

    def compile(self, weights: PyTree) -> None:
        """Compiles the programs; `weights` have the shapes of those that are tested.

        Raises:
          ConfigError: so many environments do not fit into memory.
        """
        started_s = time.monotonic()
        model = self._env.model
        state = jax.eval_shape(self._begin, model, self._keys)
        require_memory("walking_envs", len(self._keys), state)
        begin = self._begin.lower(model, self._keys)
        chunk = self._chunk.lower(model, weights, state)
        self._begin, self._chunk = compile_once(begin), compile_once(chunk)
        self.compile_s = time.monotonic() - started_s

    def run(self, weights: PyTree, on_progress: Callable[[int], None] = lambda _: None) -> Walk:
        """Tests the policy with these weights; calls back with the number of chunks done."""
        model = self._env.model
        state = self._begin(model, self._keys)
        chunks: list[Recording] = []
        for number in range(-(-self._num_steps // CHUNK_STEPS)):
            state, recorded = self._chunk(model, weights, state)
            chunks.append(jax.tree.map(np.asarray, recorded))
            on_progress(number + 1)
        steps = Recording(
            *(np.concatenate(parts)[: self._num_steps] for parts in zip(*chunks, strict=True))
        )
        ground = Ground(self._env.mj_model)
        return measure(steps, self._robot, ground, self._env.spec.control_dt_s)


def walking_env(config: EnvConfig, robot: Robot, impl: str, num_envs: int) -> Env:
    """The environments of the test of a task: as trained, with pushes, and all with one model.

    Raises:
      ConfigError: it repeats actions, or cannot be had.
    """
    if config.action_repeat != 1:  # Pushes and commands in between would not be seen.
        raise ConfigError(f"env.action_repeat={config.action_repeat}: {ONE_ACTION}")
    tested = dataclasses.replace(with_pushes(config, robot), randomize="off", curriculum="off")
    return make_envs(tested, impl, seed=0, first_env=FIRST_ENV, num_envs=num_envs)


def act_of(learner: Learner) -> Act:
    """Policies of gmijax as the test wants them; their weights are those of a saved state."""

    def act(state: PyTree, obs: Array) -> Array:
        weights = acting_weights(learner, state)
        return learner.networks.action_mean(weights.params, normalize(weights.moments, obs))

    return act


def _run_chunk(
    env: Env, readings: Readings, act: Act, model: PyTree, weights: PyTree, state: EnvState
) -> tuple[EnvState, Recording]:
    """`CHUNK_STEPS` of all environments; `env` is vectorised."""

    def step(before: EnvState, _: None) -> tuple[EnvState, Recording]:
        after = env.step(model, before, act(weights, before.obs))
        data = after.physics.data
        # One with bad numbers stays where it was: others may share buffers with it.
        bad = ~jnp.isfinite(data.qpos).all(-1) | ~jnp.isfinite(data.qvel).all(-1)
        return select_envs(bad, before, after), recorded(readings, before, after)

    return jax.lax.scan(step, state, length=CHUNK_STEPS)


def recorded(readings: Readings, before: EnvState, after: EnvState) -> Recording:
    """One step of environments [N], without the axis of time."""
    data = after.physics.data
    return Recording(
        qpos=data.qpos,
        velocity=readings.velocity(data),
        command=before.task.info["command"],
        disturbed=_disturbed(before, after),
        load=readings.load(data),
        done=after.terminated,
    )


def _disturbed(before: EnvState, after: EnvState) -> Array:
    """Environments [N] that got a push, as a force or as a velocity, or a new command."""
    new_command = (before.task.info["command"] != after.task.info["command"]).any(-1)
    forces = (after.physics.data.xfrc_applied != 0).any((-2, -1))
    kicks = after.task.info.get("push", jnp.zeros(1))
    return new_command | forces | (kicks != 0).any(-1)

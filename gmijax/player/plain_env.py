"""A shipped task in plain MuJoCo: one environment, with nothing compiled and no jax.

The task's own functions run here, on numpy (`gmijax.arrays`), so observations, rewards and ends
are those of training.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.arrays import constant
from gmijax.config import EnvConfig
from gmijax.config.schema import from_dict, known
from gmijax.errors import ConfigError
from gmijax.player.policy import PlainPolicy
from gmijax.sim.c_physics import CPhysics
from gmijax.sim.divergence import diverged_by_source, end_diverged
from gmijax.sim.interaction import action_repeat, observation_history, time_limit
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.registry import TASKS, require_env, require_own
from gmijax.sim.simulators import C
from gmijax.sim.tasks.settings import SETTINGS, settings_from

Floats: TypeAlias = npt.NDArray[np.float32]


class Step(NamedTuple):
    """The outcome of one control step.

    Attributes:
      obs: [O] float32.
      reward: the sum of `terms`.
      terms: every addend of the reward by name, weight included.
      terminated: the task has ended.
      truncated: time ran out.
    """

    obs: Floats
    reward: float
    terms: dict[str, float]
    terminated: bool
    truncated: bool


class PlainEnv:
    """One environment of a task that plays episodes one after the other.

    Forces that are written into `data.xfrc_applied` ([nbody, 6], N and N m, in the world) act in
    every step until they are changed; `reset` clears them.

    Args:
      config: the task, with its rewards, settings, time limit, history and repeated actions; its
        randomisation and curriculum are left out, as when it is played.
      seed: of the episodes' starts, commands and goals.

    Attributes:
      physics: MuJoCo in C, which simulates the task.
      state: of the task, its arrays numpy's.

    Raises:
      ConfigError: not one of our own tasks, or settings that it does not have.
    """

    def __init__(self, config: EnvConfig, seed: int = 0) -> None:
        self._env = _plain_task(config)
        self.physics: CPhysics = self._env.model
        self._task, self._settings = str(config.name), config.settings
        self._rng: Any = np.random.default_rng(seed)  # Instead of a key.
        self.state: EnvState
        self._diverged = False
        self.reset()

    @property
    def spec(self) -> EnvSpec:
        """Sizes and names; see `EnvSpec`."""
        return self._env.spec

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`."""
        return self.physics.mj_model

    @property
    def data(self) -> Any:
        """The `mujoco.MjData` that `step` moves. Positions of it are overwritten by `step`."""
        return self.physics.data

    @property
    def obs(self) -> Floats:
        """The observation [O] to act on next."""
        return np.asarray(self.state.obs, np.float32)

    @property
    def qpos(self) -> Floats:
        """Joint positions [nq], for pictures."""
        return np.asarray(self.state.physics.qpos, np.float32)

    @property
    def steps(self) -> int:
        """Control steps since the last reset."""
        return int(self.state.steps)

    @property
    def diverged(self) -> bool:
        """Whether the last step led to a bad number, by which the episode ended."""
        return self._diverged

    @property
    def metrics(self) -> dict[str, float]:
        """What the episode has reached by now, by the names of `spec.metrics`."""
        return {name: float(value) for name, value in self.state.metrics.items()}

    @property
    def command(self) -> Floats | None:
        """The command of the policy, None in a task without commands.

        It may be set, and is observed from the end of the next step on. See `command_limits`.
        """
        task = self.state.task
        return np.array(task.command) if "command" in getattr(task, "_fields", ()) else None

    @command.setter
    def command(self, value: npt.ArrayLike) -> None:
        command, task = self.command, self.state.task
        new = np.asarray(value, np.float32)
        if command is None or new.shape != command.shape:
            raise ValueError(f"{self._task} takes no command of shape {new.shape}")
        self.state = self.state._replace(task=task._replace(command=new))

    @property
    def command_limits(self) -> dict[str, float] | None:
        """The largest number of `command` either way, by names with units; None without any."""
        module = importlib.import_module(TASKS[self._task])
        if not hasattr(module, "command_limits"):
            return None
        limits = module.command_limits(settings_from(SETTINGS[self._task], self._settings))
        return {name: float(x) for name, x in zip(module.COMMAND_NAMES, limits, strict=True)}

    def reset(self, seed: int | None = None) -> Floats:
        """Starts the next episode, or with a `seed` the first one of that seed; returns [O]."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.state, self._diverged = self._env.reset(self.physics, self._rng), False
        return self.obs

    def step(self, action: npt.ArrayLike) -> Step:
        """One control step with an action [A], which is clipped to [-1, 1].

        An environment whose numbers leave every bound ends with reward 0
        (`gmijax.sim.divergence`).
        """
        before, given = self.state, constant(action)
        with np.errstate(over="ignore", invalid="ignore"):
            after = self._env.step(self.physics, before, given)
            diverged = diverged_by_source(self._env, after)["any"]
            state = end_diverged(before, after, diverged)
        self._diverged = bool(diverged)
        if self._diverged:  # It may be filmed.
            state = state._replace(physics=before.physics)
        self.state = state
        return Step(
            obs=self.obs,
            reward=float(state.reward),
            terms={name: float(value) for name, value in state.reward_terms.items()},
            terminated=bool(state.terminated),
            truncated=bool(state.truncated),
        )


def task_of(policy: PlainPolicy) -> EnvConfig:
    """The task that a policy was trained for.

    Raises:
      ConfigError: the policy has no task, or its keys are none of this version.
    """
    saved = policy.about.get("env")
    if not isinstance(saved, dict):
        raise ConfigError("the policy does not say of which task it is")
    keys, _ = known([EnvConfig], saved, "env.")
    return from_dict(EnvConfig, keys, "env.")


def _plain_task(config: EnvConfig) -> Env:
    require_own(config)
    require_env(config)
    module = importlib.import_module(TASKS[str(config.name)])
    env: Env = module.make(impl=C, rewards=config.rewards, settings=config.settings)
    env = time_limit(env, config.episode_length or env.spec.episode_length)
    return observation_history(action_repeat(env, config.action_repeat), config.history)

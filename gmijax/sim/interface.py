"""The interface of an environment: functions of a single one, `jax.vmap` makes a batch.

An `Env` is a value: two pure functions, a model and a description. Wrappers take an `Env` and
return an `Env`. The model is an argument of both functions, never a closure, so that domain
randomisation is an `in_axes` over some of its leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from gmijax.types import Array, PRNGKey, PyTree

OVERFLOWS = ("contact", "constraint")
"""Buffers of MJX-Warp that can be too small: contacts of all environments, constraints of one."""


class EnvSpec(NamedTuple):
    """What an environment is, in numbers.

    Attributes:
      name: the task's name in the registry.
      obs_size: O, length of an observation vector.
      action_size: A, length of an action vector; actions are clipped to [-1, 1].
      control_dt_s: seconds of simulated time per step.
      episode_length: steps after which an episode is truncated.
      reward_terms: names of the addends of the reward, in order.
      max_abs_obs: an observation beyond this counts as diverging physics; the environment
        is ended (see `gmijax.sim.divergence`).
      metrics: names of the numbers that judge an episode beside its return, such as successes.
      obs_terms: parts of an observation in order, name and length each; they go into exported
        policies. Empty where it is unknown.
      actor_obs_size: the policy sees the first so many numbers of an observation, the value
        function all of them (an asymmetric actor-critic); None: both see all.
    """

    name: str
    obs_size: int
    action_size: int
    control_dt_s: float
    episode_length: int
    reward_terms: tuple[str, ...]
    max_abs_obs: float = 1e5
    metrics: tuple[str, ...] = ()
    obs_terms: tuple[tuple[str, int], ...] = ()
    actor_obs_size: int | None = None


class EnvState(NamedTuple):
    """State of one environment and the outcome of its last step.

    Attributes:
      physics: what the simulator must remember between steps (see `gmijax.sim.physics`).
      task: the task's own typed memory (a NamedTuple of arrays, or `()`).
      obs: [O] float32.
      reward: [] float32, the sum of `reward_terms`.
      reward_terms: every addend of the reward by name, weight included, [] float32 each.
      metrics: what the episode has reached by now, [] float32 each; the values of its last step
        are logged. Sums and means over an episode are kept in `task`.
      terminated: [] bool, the task has ended: the value of what follows is zero.
      truncated: [] bool, time ran out: bootstrap from the value of this observation.
      steps: [] int32, steps since the last reset.
      key: the environment's own random key; the next reset and the policy's noise come from it.
    """

    physics: PyTree
    task: PyTree
    obs: Array
    reward: Array
    reward_terms: dict[str, Array]
    metrics: dict[str, Array]
    terminated: Array
    truncated: Array
    steps: Array
    key: PRNGKey


class Env(NamedTuple):
    """A simulated task.

    Attributes:
      spec: sizes and names.
      model: the physics model (`mjx.Model`); pass it, or a randomised copy, to the functions.
      reset: `(model, key) -> EnvState`, a fresh episode of one environment; consumes `key`.
      step: `(model, state, action [A]) -> EnvState`, one control step of one environment.
      mj_model: the `mujoco.MjModel` behind `model`, for rendering and for the C oracle.
      qpos: `EnvState -> [nq]`, joint positions for rendering; after them, where mocap bodies
        move, their positions and their quaternions.
      max_envs: most environments that may be stepped at once, None for no limit.
      overflow: `EnvState -> [2]` bool, which of `OVERFLOWS` were too small in the last step; None
        if nothing can overflow.
      model_axes: `in_axes` of `model` for `vmap` over environments: None if they share it, else a
        tree with 0 at the leaves that have a leading axis [N] (see `gmijax.sim.randomize`).
      next_episode: `(model, ended EnvState) -> EnvState`, the episode that follows one of the same
        environment, for tasks that carry something on in `task`, such as the level of a
        curriculum. None: `reset(model, ended.key)`. Of an environment that diverged `task` is
        that of one step earlier.
      draw_models: `keys [N] -> model`, domain randomisation that the task brings itself: all
        leaves have an axis [N]. None if it brings none.
      command: `EnvState -> [3]`, the velocity that a robot is commanded, for films: m/s forwards
        and to the left, rad/s to the left. None if there is none.
    """

    spec: EnvSpec
    model: PyTree
    reset: Callable[[PyTree, PRNGKey], EnvState]
    step: Callable[[PyTree, EnvState, Array], EnvState]
    mj_model: Any
    qpos: Callable[[EnvState], Array]
    max_envs: int | None = None
    overflow: Callable[[EnvState], Array] | None = None
    model_axes: PyTree = None
    next_episode: Callable[[PyTree, EnvState], EnvState] | None = None
    draw_models: Callable[[PRNGKey], PyTree] | None = None
    command: Callable[[EnvState], Array] | None = None

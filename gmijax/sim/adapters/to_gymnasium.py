"""Our environments as Gymnasium's vector environments: `gmijax.make_vector_env`."""

from __future__ import annotations

import importlib
from typing import Any, Literal

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector.array_conversion import ArrayConversion

from gmijax.sim.interface import Env
from gmijax.sim.wrappers import BatchState, env_keys, training_env
from gmijax.types import Array

FINAL_OBS = "final_obs"


class GmijaxVectorEnv(VectorEnv[Array, Array, Array]):
    """N environments that are stepped by one compiled program, with arrays of jax.

    A world starts over in the step that ends its episode (`AutoresetMode.SAME_STEP`): the
    observations of a step are those to act on next, `info["final_obs"]` [N, O] has what the
    actions led to, which is the last observation where the mask `info["_final_obs"]` [N] is true.
    To bootstrap the value of an episode that was truncated, take it from there.

    Rewards are float32 [N], terminations and truncations bool [N], actions are clipped to
    [-1, 1]. The same seed gives the same episodes on the same machine.
    """

    def __init__(self, env: Env, num_envs: int) -> None:
        spec = env.spec
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (spec.obs_size,))
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (spec.action_size,))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        batched = training_env(env)
        self._model = env.model
        self._init, self._step = jax.jit(batched.init), jax.jit(batched.step)
        self._state: BatchState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Starts new episodes in all worlds; without a seed others than before."""
        super().reset(seed=seed, options=options)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        self._state = state = self._init(self._model, env_keys(key, 0, self.num_envs))
        return state.env.obs, {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One control step of all worlds under actions [N, A]."""
        if self._state is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        actions = jnp.asarray(actions, jnp.float32)
        if actions.shape != self.action_space.shape:
            raise gym.error.InvalidAction(
                f"actions of shape {actions.shape}: expected {self.action_space.shape}"
            )
        state, out = self._step(self._model, self._state, actions)
        self._state = state
        info = {FINAL_OBS: out.next_obs, f"_{FINAL_OBS}": out.terminated | out.truncated}
        return state.env.obs, out.reward, out.terminated, out.truncated, info


def vector_env(
    env: Env, num_envs: int, arrays: Literal["numpy", "torch", "jax"]
) -> VectorEnv[Any, Any, Any]:
    """See `gmijax.sim.registry.make_vector_env`."""
    ours = GmijaxVectorEnv(env, num_envs)
    if arrays == "jax":
        return ours
    return ArrayConversion(ours, env_xp=jnp, target_xp=importlib.import_module(arrays))

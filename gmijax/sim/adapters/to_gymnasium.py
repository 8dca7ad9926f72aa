"""Our environments as Gymnasium's vector environments: `gmijax.make_vector_env`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, Final

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gmijax.sim.adapters.caller_arrays import Arrays, hand_out, take_in
from gmijax.sim.adapters.pictures import Pictures
from gmijax.sim.adapters.vector_programs import Autoreset, VectorOutcome, VectorPrograms
from gmijax.sim.interface import Env
from gmijax.sim.stage import Image
from gmijax.sim.wrappers import BatchState, env_keys
from gmijax.types import PRNGKey

AUTORESET_MODES: Final = MappingProxyType(
    {
        "same_step": AutoresetMode.SAME_STEP,
        "next_step": AutoresetMode.NEXT_STEP,
        "disabled": AutoresetMode.DISABLED,
    }
)
RESET_MASK: Final = "reset_mask"
_NOT_IN_A_NAME = re.compile(r"[^\w.-]+")


class GmijaxVectorEnv(VectorEnv[Any, Any, Any]):
    """N environments that are stepped by one compiled program.

    Rewards are float32 [N], terminations and truncations bool [N], actions are clipped to
    [-1, 1]. `info["is_diverged"]` [N] marks environments that were ended because of a bad number,
    an action that is NaN among them; they count as terminated. The same seed gives the same
    episodes on the same machine.

    With `autoreset="same_step"` the observations of a step are those to act on next, and where
    the mask `info["_final_obs"]` [N] is true `info["final_obs"]` [N, O] is the last one of the
    episode that ended; take the value of a truncated episode from there. `info["final_info"]` has
    `is_diverged`, and the episode's return and length as `episode["r"]` and `episode["l"]`. These
    entries are there if an episode has ended; with arrays on a device, where asking would wait
    for it, in every step.

    With `autoreset="disabled"` an environment that has ended stays at its end, with reward 0,
    until `reset(options={"reset_mask": mask})` is called with a mask [N] that is true for it.

    Attributes:
      episode_length: steps after which an episode is truncated.
    """

    def __init__(
        self,
        env: Env,
        num_envs: int,
        *,
        arrays: Arrays = "numpy",
        autoreset: Autoreset = "same_step",
        render_mode: str | None = None,
        random_ep_len: bool = False,
    ) -> None:
        self.task_spec = env.spec
        self.num_envs = num_envs
        self.episode_length = env.spec.episode_length
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (env.spec.obs_size,))
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (env.spec.action_size,))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {
            "autoreset_mode": AUTORESET_MODES[autoreset],
            "render_modes": ["rgb_array"],
        }
        if math.isfinite(env.spec.control_dt_s):
            self.metadata["render_fps"] = 1.0 / env.spec.control_dt_s
        self.spec = EnvSpec(
            f"gmijax/{_NOT_IN_A_NAME.sub('_', env.spec.name)}",
            max_episode_steps=self.episode_length,
        )
        self.render_mode = render_mode
        self._pictures = None if render_mode is None else Pictures(env)
        self._arrays: Arrays = arrays
        self._programs = VectorPrograms(env, autoreset, random_ep_len=random_ep_len)
        self._state: BatchState | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes; without a seed others than before.

        Args:
          seed: for all environments, or a list with one for each, None for any.
          options: `{"reset_mask": mask}`, bool [N]: only there; the other environments continue.

        Returns:
          Observations [N, O] of all environments, and an empty dict.
        """
        options = options or {}
        if unknown := options.keys() - {RESET_MASK}:
            raise gym.error.Error(f"options {sorted(unknown)}: allowed: {RESET_MASK}")
        keys = self._keys(seed)
        if RESET_MASK in options:
            mask = self._mask(options[RESET_MASK])
            self._state = state = self._programs.start_some(self._running(), keys, mask)
        else:
            self._state = state = self._programs.start(keys)
        # A buffer of its own: the caller may write into it.
        return hand_out(jnp.copy(state.env.obs), self._arrays), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step of all environments under actions [N, A]."""
        state = self._running()
        actions = take_in(actions)
        if actions.shape != self.action_space.shape:
            raise gym.error.InvalidAction(
                f"actions of shape {actions.shape}: expected {self.action_space.shape}"
            )
        self._state, outcome = self._programs.step(state, actions)
        out: VectorOutcome = hand_out(outcome, self._arrays)
        info = {"is_diverged": out.is_diverged}
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            info |= self._final(out)
        return out.obs, out.reward, out.terminated, out.truncated, info

    def render(self) -> tuple[Image, ...] | None:
        """A picture [height, width, 3] of every environment now; None without a render_mode."""
        return None if self._pictures is None else self._pictures.of(self._running().env)

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """An attribute of every environment, or what its method returns, as of `SyncVectorEnv`.

        skrl draws by it after every step, whether or not there is a render_mode.
        """
        found = getattr(self, name)
        return found(*args, **kwargs) if callable(found) else (found,) * self.num_envs

    def _final(self, out: VectorOutcome) -> dict[str, Any]:
        """Gymnasium's `info` of episodes that ended; as arrays, not as objects."""
        ended = out.terminated | out.truncated
        if self._arrays == "numpy" and not ended.any():
            return {}
        final_info = {
            "is_diverged": out.is_diverged,
            "episode": {"r": out.episode_return, "l": out.episode_length},
            "_episode": ended,
        }
        return {
            "final_obs": out.final_obs,
            "_final_obs": ended,
            "final_info": final_info,
            "_final_info": ended,
        }

    def close_extras(self, **_: Any) -> None:
        """Gives OpenGL back."""
        if self._pictures is not None:
            self._pictures.close()

    @property
    def state(self) -> BatchState:
        """All environments; a bridge to another library may change its parts."""
        return self._running()

    @state.setter
    def state(self, state: BatchState) -> None:
        self._state = state

    def _running(self) -> BatchState:
        if self._state is None:
            raise gym.error.ResetNeeded("call reset() of all environments first")
        return self._state

    def _keys(self, seed: int | Sequence[int | None] | None) -> PRNGKey:
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
            return env_keys(jax.random.key(self._any_seed()), 0, self.num_envs)
        if len(seed) != self.num_envs:
            raise gym.error.Error(f"{len(seed)} seeds: expected one for each of {self.num_envs}")
        # What an environment draws depends on its own seed, which may be any natural number.
        own = [self._any_seed() if one is None else int(one) for one in seed]
        words = [np.random.SeedSequence(one).generate_state(1)[0] for one in own]
        return jax.vmap(jax.random.key)(np.asarray(words, np.uint32))

    def _any_seed(self) -> int:
        return int(self.np_random.integers(2**31))

    def _mask(self, given: Any) -> Any:
        mask = np.asarray(given.cpu() if hasattr(given, "cpu") else given)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise gym.error.Error(
                f"options {RESET_MASK} of type {mask.dtype}, shape {mask.shape}: "
                f"expected bool, ({self.num_envs},)"
            )
        return mask


def make(env: Env, num_envs: int, **options: Any) -> GmijaxVectorEnv:
    """N environments of Gymnasium; `options` are those of `GmijaxVectorEnv`."""
    return GmijaxVectorEnv(env, num_envs, **options)

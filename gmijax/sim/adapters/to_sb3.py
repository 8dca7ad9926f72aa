"""Our environments as a `VecEnv` of Stable-Baselines3: `make_vector_env(..., api="sb3")`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
from gmijax.sim.interface import Env


class Sb3VecEnv(VecEnv):
    """N environments for Stable-Baselines3, which logs their returns as those of a `Monitor`.

    Environments are no objects of their own: `get_attr` gives the same value for all of them, and
    there is nothing for `env_method` to call.
    """

    def __init__(self, envs: GmijaxVectorEnv) -> None:
        self.envs = envs
        self._actions: Any = None
        self._start_s = time.time()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Starts new episodes in all environments; from the seeds of `seed`, if it was called."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        obs, _ = self.envs.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """One control step of all environments."""
        obs, reward, terminated, truncated, info = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = terminated | truncated
        for index in np.flatnonzero(ended):
            final = info["final_info"]
            episode = {key: final["episode"][key][index].item() for key in ("r", "l")}
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "is_diverged": bool(final["is_diverged"][index]),
                "episode": episode | {"t": round(time.time() - self._start_s, 6)},
            }
        return obs, reward, ended, infos

    def close(self) -> None:
        """Closes the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray]:
        """A picture of every environment."""
        return self.envs.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environments, once for each of `indices`."""
        return [getattr(self.envs, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: environments have no attributes of their own."""
        raise AttributeError(
            f"{attr_name}: environments share one program, and have no attributes"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refused: environments have no methods of their own."""
        raise AttributeError(
            f"{method_name}(): environments share one program, and have no methods"
        )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """True for `Monitor`, whose entry in `infos` is there."""
        return [issubclass(wrapper_class, Monitor)] * len(self._indices(indices))

    def _indices(self, indices: Any) -> Sequence[int]:
        return list(self._get_indices(indices))


def make(env: Env, num_envs: int, **options: Any) -> Sb3VecEnv:
    """N environments of Stable-Baselines3; `options` are those of `GmijaxVectorEnv`."""
    return Sb3VecEnv(GmijaxVectorEnv(env, num_envs, **options))

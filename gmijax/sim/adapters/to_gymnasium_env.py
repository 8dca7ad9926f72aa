"""One of our environments as an `Env` of Gymnasium, for tools that take no other."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
from gmijax.sim.stage import Image


class GmijaxEnv(gym.Env[np.ndarray, np.ndarray]):
    """The only environment of `envs`, which has numpy arrays and no autoreset.

    It costs a call of a compiled program for every step of one environment: train with
    `gmijax.make_vector_env`.
    """

    def __init__(self, envs: GmijaxVectorEnv) -> None:
        self._envs = envs
        self.observation_space = envs.single_observation_space
        self.action_space = envs.single_action_space
        self.render_mode = envs.render_mode
        shared = {"render_modes", "render_fps"}
        self.metadata = {key: value for key, value in envs.metadata.items() if key in shared}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts a new episode; without a seed another than before."""
        super().reset(seed=seed)
        obs, _ = self._envs.reset(seed=[int(self.np_random.integers(2**63))], options=options)
        return obs[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step under `action` [A]."""
        obs, reward, terminated, truncated, info = self._envs.step(np.asarray(action)[None])
        info = {"is_diverged": bool(info["is_diverged"][0])}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> Image | None:
        """A picture [height, width, 3] of the environment; None without a render_mode."""
        pictures = self._envs.render()
        return None if pictures is None else pictures[0]

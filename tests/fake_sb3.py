"""As much of Stable-Baselines3 as a `VecEnv` of ours needs, where it is not installed."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest


class VecEnv:
    """Its base class: keeps its arguments, and seeds of the next reset."""

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs = num_envs
        self.observation_space = observation_space
        self.action_space = action_space
        self._reset_seeds()
        self.render_mode = self.get_attr("render_mode")[0]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        raise NotImplementedError

    def step_async(self, actions: Any) -> None:
        raise NotImplementedError

    def step_wait(self) -> Any:
        raise NotImplementedError

    def step(self, actions: Any) -> Any:
        self.step_async(actions)
        return self.step_wait()

    def seed(self, seed: int) -> list[int]:
        self._seeds = [seed + i for i in range(self.num_envs)]
        return self._seeds

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _reset_options(self) -> None:
        pass

    def _get_indices(self, indices: Any) -> Any:
        return range(self.num_envs) if indices is None else indices


class Monitor:
    """The wrapper that counts episodes."""


def install(patch: pytest.MonkeyPatch) -> None:
    """Puts it where the library would be."""
    for name in ("stable_baselines3", "stable_baselines3.common"):
        patch.setitem(sys.modules, name, ModuleType(name))
    for name, member in (("monitor", Monitor), ("vec_env", VecEnv)):
        module: Any = ModuleType(f"stable_baselines3.common.{name}")
        setattr(module, member.__name__, member)
        patch.setitem(sys.modules, module.__name__, module)

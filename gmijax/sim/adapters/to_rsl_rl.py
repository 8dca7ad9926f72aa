"""Our environments as a `VecEnv` of rsl_rl: `make_vector_env(..., api="rsl_rl")`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import torch  # pyright: ignore[reportMissingImports]
from rsl_rl.env import VecEnv  # pyright: ignore[reportMissingImports]
from tensordict import TensorDict  # pyright: ignore[reportMissingImports]

from gmijax.sim.adapters.caller_arrays import hand_out
from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
from gmijax.sim.interface import Env


@dataclass(frozen=True)
class EnvCfg:
    """What loggers of rsl_rl note of the environments."""

    task: str
    num_envs: int
    max_episode_length: int
    control_dt_s: float


class RslRlVecEnv(VecEnv):
    """N environments for rsl_rl. They start by themselves, from the seed of `reset`.

    Observations are a group `policy`, and where the value function sees more, a group `critic`
    with all of it. Writing to `episode_length_buf` shortens the running episodes, as
    `OnPolicyRunner.learn(init_at_random_ep_len=True)` does.
    """

    def __init__(self, envs: GmijaxVectorEnv) -> None:
        spec = envs.task_spec
        self.envs = envs
        self.num_envs = envs.num_envs
        self.num_actions = spec.action_size
        self.max_episode_length = spec.episode_length
        self.cfg = EnvCfg(spec.name, envs.num_envs, spec.episode_length, spec.control_dt_s)
        self.reset()
        self.device = self._obs.device

    def reset(self, seed: int | None = None) -> tuple[TensorDict, dict[str, Any]]:
        """Starts new episodes in all environments; without a seed others than before."""
        self._obs, _ = self.envs.reset(seed=seed)
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        """What to act on next."""
        seen = self.envs.task_spec.actor_obs_size
        groups = {"policy": self._obs if seen is None else self._obs[:, :seen]}
        if seen is not None:
            groups["critic"] = self._obs
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One control step of all environments under actions [N, A]."""
        self._obs, reward, terminated, truncated, info = self.envs.step(actions)
        extras = {
            "time_outs": truncated,
            "log": {"/diverged": info["is_diverged"].float().mean()},
        }
        return self.get_observations(), reward, terminated | truncated, extras

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """[N] int64, steps of the running episodes."""
        state = self.envs.state
        return hand_out(state.env.steps + state.head_start, "torch").long()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        state = self.envs.state
        wanted = jnp.asarray(steps.cpu().numpy(), state.head_start.dtype)
        head_start = jnp.maximum(wanted - state.env.steps, 0)
        self.envs.state = state._replace(head_start=head_start)


def make(env: Env, num_envs: int) -> RslRlVecEnv:
    """N environments of rsl_rl."""
    return RslRlVecEnv(GmijaxVectorEnv(env, num_envs, arrays="torch", random_ep_len=True))

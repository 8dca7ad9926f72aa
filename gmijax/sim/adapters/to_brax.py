"""Our environments as Brax's, for Brax's own training: `make_env("ant", api="brax")`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from gmijax.sim import interface
from gmijax.sim.adapters.brax_interface import POLICY_OBS, PRIVILEGED_OBS
from gmijax.types import Array, PyTree

_KEY = "gmijax_key"


class BraxEnv(Env):
    """A single gmijax environment with the interface of Brax.

    It has no time limit: `brax.envs.training.wrap(env, episode_length=env.episode_length)` sets
    it, and `info["truncation"]`. `metrics` has every term of the reward as `reward/<name>`, which
    Brax sums over episodes; the task's own metrics are values of a moment, and stand in
    `info["task_metrics"]`. Where only the value function sees all of an observation it is a dict,
    as in Playground: `state` for the policy, `privileged_state` for the value function.

    Brax's automatic reset goes back to the first start of an environment, not to a new one.
    """

    def __init__(self, env: interface.Env) -> None:
        self._env = env

    def reset(self, rng: Array) -> State:
        """Starts an episode from a key, new-style or plain integers [2]."""
        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        return _to_state(self._env.spec, self._env.reset(self._env.model, rng), {}, {})

    def step(self, state: State, action: Array) -> State:
        """One control step of one environment under `action` [A]."""
        # The key is kept outside of what Brax's reset brings back: each episode draws anew.
        before: Any = state.pipeline_state
        key = jax.random.wrap_key_data(state.info[_KEY])
        moved = self._env.step(self._env.model, before._replace(key=key), action)
        return _to_state(self._env.spec, moved, state.info, state.metrics)

    @property
    def observation_size(self) -> Any:
        """O, or the shapes of the entries `state` and `privileged_state`."""
        size, seen = self._env.spec.obs_size, self._env.spec.actor_obs_size
        return size if seen is None else {POLICY_OBS: (seen,), PRIVILEGED_OBS: (size,)}

    @property
    def action_size(self) -> int:
        """A."""
        return self._env.spec.action_size

    @property
    def backend(self) -> str:
        """Physics is MuJoCo's."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Seconds of simulated time per step."""
        return self._env.spec.control_dt_s

    @property
    def episode_length(self) -> int:
        """The task's own time limit, for `EpisodeWrapper`."""
        return self._env.spec.episode_length

    @property
    def mj_model(self) -> Any:
        """The MuJoCo model, for rendering."""
        return self._env.mj_model


def _to_state(
    spec: interface.EnvSpec,
    state: interface.EnvState,
    info: dict[str, Any],
    metrics: dict[str, Array],
) -> State:
    obs: Any = state.obs
    if spec.actor_obs_size is not None:
        obs = {POLICY_OBS: obs[..., : spec.actor_obs_size], PRIVILEGED_OBS: obs}
    # What Brax's wrappers have put into `info` and `metrics` stays.
    terms = {f"reward/{name}": value for name, value in state.reward_terms.items()}
    mine: dict[str, PyTree] = {
        _KEY: jax.random.key_data(state.key),
        "task_metrics": state.metrics,
    }
    return State(
        pipeline_state=state._replace(key=()),  # pyright: ignore[reportArgumentType]
        obs=obs,
        reward=state.reward,
        done=(state.terminated | state.truncated).astype(jnp.float32),
        metrics={**metrics, **terms},
        info={**info, **mine},
    )

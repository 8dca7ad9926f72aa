"""A run by Brax's PPO in a process of its own: `python -m benchmarks.peers.brax_ppo IN OUT`.

IN is a JSON file with a `BraxTraining`; OUT gets the curve, seconds since the start and
environment steps by then, and mean returns of the latest episodes, if the arguments ask for them.
"""

from __future__ import annotations

import functools
import importlib
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from benchmarks.peers.comparisons import BraxTraining
from gmijax.errors import ConfigError
from gmijax.runs.folder import read_json, write_json
from gmijax.sim.adapters.playground import without_warnings
from gmijax.sim.adapters.playground_package import import_playground
from gmijax.sim.registry import make_env
from gmijax.types import PyTree

_RETURN = "episode/sum_reward"
"""Of the latest 100 episodes that ended; it comes in reports of its own."""


def main() -> int:
    """Trains, and writes the curve; returns 1 if the losses were not finite at the end."""
    started_s = time.monotonic()
    training = BraxTraining(**read_json(Path(sys.argv[1])))
    curve: list[tuple[float, int]] = []
    returns: list[tuple[int, float]] = []
    last: dict[str, float] = {}

    def progress(steps: int, metrics: Mapping[str, Any]) -> None:
        if _RETURN in metrics:
            returns.append((int(steps), float(metrics[_RETURN])))
        else:
            curve.append((time.monotonic() - started_s, int(steps)))
            last.update({name: float(value) for name, value in metrics.items()})
        # Now, for what reads it after a run that was stopped.
        write_json(Path(sys.argv[2]), {"curve": curve, "returns": returns})

    train(training, progress)
    if bad := [name for name, value in last.items() if not math.isfinite(value)]:
        sys.stderr.write(f"{bad[0]} is {last[bad[0]]} at the end of the training\n")
        return 1
    return 0


def train(training: BraxTraining, progress: Any) -> None:
    """Brax's PPO; `progress(steps, metrics)` is called after each of its parts."""
    # Brax 0.14.2 calls a function that JAX 0.10 has no more.
    jax.device_put_replicated = replicated
    ppo = importlib.import_module("brax.training.agents.ppo.train")
    networks = importlib.import_module("brax.training.agents.ppo.networks")
    env, arguments = environment(training)
    value_obs: dict[str, str] = {}
    if isinstance(env.observation_size, Mapping) and "privileged_state" in env.observation_size:
        value_obs["value_obs_key"] = "privileged_state"
    ppo.train(
        environment=env,
        progress_fn=progress,
        network_factory=functools.partial(
            networks.make_ppo_networks, activation=linen.elu, **value_obs, **training.networks
        ),
        **{**training.arguments, **arguments},
    )


def environment(training: BraxTraining) -> tuple[Any, dict[str, Any]]:
    """The environment without wrappers, and the arguments of `train` that depend on it."""
    length = training.arguments["episode_length"]
    if training.suite == "gmijax":
        # Environments of MJX-Warp share buffers that are made for so many.
        envs = training.arguments["num_envs"]
        env = make_env(training.env, impl=training.impl, api="brax", max_envs=envs)
        return env, {"episode_length": length or env.episode_length}
    if training.suite == "brax":
        # The backend of Brax's own training script, and of ours.
        envs = importlib.import_module("brax.envs")
        return envs.get_environment(training.env, backend="mjx"), {
            "episode_length": length or 1000
        }
    if training.suite == "playground":
        playground = import_playground()
        env = playground.registry.load(training.env, config_overrides={"impl": training.impl})
        if training.impl == "warp":
            env = without_warnings(env)
        own = playground.registry.get_default_config(training.env).episode_length
        wrap = playground.wrapper.wrap_for_brax_training
        return env, {"episode_length": length or own, "wrap_env_fn": wrap}
    raise ConfigError(f"suite={training.suite}: expected one of gmijax, brax, playground")


def replicated(tree: PyTree, devices: Sequence[Any]) -> PyTree:
    """What `jax.device_put_replicated` did: every leaf [...] as [D, ...], one row on each device.

    As JAX's page on the new `pmap` has it.
    """
    sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
    return jax.tree.map(
        lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), sharding), tree
    )


if __name__ == "__main__":
    sys.exit(main())

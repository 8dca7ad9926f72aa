"""Tests checkpoints in a process of its own: `python -m benchmarks.walking_tests IN OUT`.

IN is a JSON file: `env`, the task; `impl`, of the physics; `num_envs` and `seed` of the test;
`runs`, lists of checkpoint folders, each the fewest steps first. OUT gets, after every test,
`walks`, a list for each run: a `Walk` for each checkpoint, up to the second in a row that walks.
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.walking import BRAX_CONFIG
from gmijax.config import EnvConfig
from gmijax.config.schema import from_dict
from gmijax.errors import ConfigError
from gmijax.learning.walking import Act, WalkingTest, walking_env
from gmijax.player.joystick import robot_of
from gmijax.player.policy import read_policy
from gmijax.runs.folder import POLICY, read_json, write_json
from gmijax.sim.impl import choose_impl
from gmijax.sim.interface import Env


class Policy(NamedTuple):
    """What acts, and with which weights."""

    act: Act
    weights: Any


def main() -> int:
    """Tests everything that is asked for."""
    asked, out = read_json(Path(sys.argv[1])), Path(sys.argv[2])
    config = from_dict(EnvConfig, asked["env"])
    robot, num_envs = robot_of(config), asked["num_envs"]
    if robot is None:
        raise ConfigError(f"env={config.label}: has no walking test")
    impl, _ = choose_impl(asked["impl"], jax.default_backend(), config.label)
    env = walking_env(config, robot, impl, num_envs)
    tests: dict[str, WalkingTest] = {}
    found: list[list[dict[str, Any]]] = [[] for _ in asked["runs"]]
    for run, walks in zip(asked["runs"], found, strict=True):
        for folder in map(Path, run):
            kind, policy = policy_of(folder, env)
            if kind not in tests:
                tests[kind] = WalkingTest(
                    env, robot, policy.act, num_envs=num_envs, seed=asked["seed"]
                )
                tests[kind].compile(policy.weights)
            walks.append(tests[kind].run(policy.weights).as_json())
            write_json(out, {"walks": found})
            if walks_twice(walks):
                break
    return 0


def walks_twice(walks: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the last two both walk."""
    return len(walks) > 1 and all(walk["walks"] for walk in walks[-2:])


def policy_of(checkpoint: Path, env: Env) -> tuple[str, Policy]:
    """Whose policy a checkpoint has, `gmijax` or `brax`, and the policy."""
    if (checkpoint / POLICY).exists():
        return "gmijax", _ours(checkpoint)
    return "brax", _of_brax(checkpoint, env)


def _ours(checkpoint: Path) -> Policy:
    policy = read_policy(checkpoint / POLICY)
    names = ("kernels", "biases", "obs_mean", "obs_std")
    weights = {name: jax.tree.map(jnp.asarray, getattr(policy, name)) for name in names}
    return Policy(lambda given, obs: dataclasses.replace(policy, **given)(obs), weights)


def _of_brax(checkpoint: Path, env: Env) -> Policy:
    """A policy of Brax's PPO, with the observations that its networks want."""
    saved = importlib.import_module("brax.training.agents.ppo.checkpoint")
    networks = importlib.import_module("brax.training.agents.ppo.networks")
    make_policy = networks.make_inference_fn(_network(read_json(checkpoint / BRAX_CONFIG)))
    seen = env.spec.actor_obs_size

    def act(weights: Any, obs: Any) -> Any:
        named = {"state": obs[:, :seen], "privileged_state": obs[:, seen:]}
        return make_policy(weights, deterministic=True)(named, jax.random.key(0))[0]

    return Policy(act, jax.tree.map(jnp.asarray, saved.load(checkpoint)))


def _network(config: Mapping[str, Any]) -> Any:
    """The networks of a checkpoint; Brax 0.14.2 cannot make them of its own file.

    That has shapes for sizes, and no initialisers where they are the default.
    """
    networks = importlib.import_module("brax.training.agents.ppo.networks")
    options = {
        name: value
        for name, value in config["network_factory_kwargs"].items()
        if value is not None and not name.endswith("kernel_init_fn")
    }
    if "activation" in options:
        known = importlib.import_module("brax.training.networks").ACTIVATION
        options["activation"] = known[options["activation"]]
    if config["normalize_observations"]:
        statistics = importlib.import_module("brax.training.acme.running_statistics")
        options["preprocess_observations_fn"] = statistics.normalize
    sizes = {
        name: tuple(size["shape"] if isinstance(size, Mapping) else size)
        for name, size in config["observation_size"].items()
    }
    return networks.make_ppo_networks(sizes, config["action_size"], **options)


if __name__ == "__main__":
    sys.exit(main())

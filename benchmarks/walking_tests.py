"""Tests checkpoints in a process of its own: `python -m benchmarks.walking_tests IN OUT`.

IN is a JSON file: `env`, the task; `num_envs` and `seed` of the test; `runs`, lists of checkpoint
folders, each the fewest steps first; `impls`, for each run what it asked for as physics. OUT gets,
after every test, `walks`, a list for each run: a `Walk`, with `impl`, for each checkpoint, up to
the second in a row that walks.
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
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import POLICY, read_json, write_json
from gmijax.sim.impl import choose_impl, impl_of_policy
from gmijax.sim.interface import Env
from gmijax.sim.robots import changed_settings

_WEIGHTS = ("kernels", "biases", "norms", "obs_mean", "obs_std")
"""What of a policy of ours is given to its compiled test; all else is in the program."""


class Policy(NamedTuple):
    """What acts, and with which weights.

    Attributes:
      kind: policies of one kind are tested by one program.
    """

    kind: tuple[Any, ...]
    act: Act
    weights: Any


def main() -> int:
    """Tests everything that is asked for."""
    asked, out = read_json(Path(sys.argv[1])), Path(sys.argv[2])
    config = from_dict(EnvConfig, asked["env"])
    robot, num_envs = robot_of(config), asked["num_envs"]
    if robot is None:
        raise ConfigError(f"env={config.label}: has no walking test")
    envs: dict[str, Env] = {}
    tests: dict[tuple[Any, ...], WalkingTest] = {}
    found: list[list[dict[str, Any]]] = [[] for _ in asked["runs"]]
    for run, wanted, walks in zip(asked["runs"], asked["impls"], found, strict=True):
        for folder in map(Path, run):
            wished = impl_of_policy(wanted, _trained_with(folder))
            impl, _ = choose_impl(wished, jax.default_backend(), config.label)
            if impl not in envs:
                envs[impl] = walking_env(config, robot, impl, num_envs)
            policy = policy_of(folder, envs[impl])
            kind = (impl, *policy.kind)
            if kind not in tests:
                tests[kind] = WalkingTest(
                    envs[impl], robot, policy.act, num_envs=num_envs, seed=asked["seed"]
                )
                tests[kind].compile(policy.weights)
            walk = tests[kind].run(policy.weights)._replace(settings=changed_settings(config))
            walks.append({**walk.as_json(), "impl": impl})
            write_json(out, {"walks": found})
            if walks_twice(walks):
                break
    return 0


def walks_twice(walks: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the last two both walk."""
    return len(walks) > 1 and all(walk["walks"] for walk in walks[-2:])


def _trained_with(checkpoint: Path) -> str | None:
    """The physics that a checkpoint of ours was trained with; None of one of Brax's."""
    return CheckpointMeta.read(checkpoint).impl if (checkpoint / POLICY).exists() else None


def policy_of(checkpoint: Path, env: Env) -> Policy:
    """The policy of a checkpoint, ours or Brax's."""
    return _ours(checkpoint) if (checkpoint / POLICY).exists() else _of_brax(checkpoint, env)


def _ours(checkpoint: Path) -> Policy:
    policy = read_policy(checkpoint / POLICY)
    weights = {name: jax.tree.map(jnp.asarray, getattr(policy, name)) for name in _WEIGHTS}
    shapes = str(jax.tree.map(jnp.shape, weights))  # Of one with layer norm, that of its norms.
    kind = ("gmijax", policy.head, policy.obs_clip, policy.action_size, shapes)
    return Policy(kind, lambda given, obs: dataclasses.replace(policy, **given)(obs), weights)


def _of_brax(checkpoint: Path, env: Env) -> Policy:
    """A policy of Brax's PPO, with the observations that its networks want."""
    saved = importlib.import_module("brax.training.agents.ppo.checkpoint")
    networks = importlib.import_module("brax.training.agents.ppo.networks")
    make_policy = networks.make_inference_fn(_network(read_json(checkpoint / BRAX_CONFIG)))
    seen = env.spec.actor_obs_size

    def act(weights: Any, obs: Any) -> Any:
        named = {"state": obs[:, :seen], "privileged_state": obs[:, seen:]}
        return make_policy(weights, deterministic=True)(named, jax.random.key(0))[0]

    return Policy(("brax",), act, jax.tree.map(jnp.asarray, saved.load(checkpoint)))


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

"""Environments of MuJoCo Playground: `env=go1`, `env=playground env.name=CartpoleBalance`."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.config.env import ROBOTS, label_of
from gmijax.config.schema import close_name, flatten, suggestion
from gmijax.errors import ConfigError
from gmijax.sim.adapters.brax_interface import adapt
from gmijax.sim.adapters.checks import attempt
from gmijax.sim.adapters.playground_package import import_playground
from gmijax.sim.impl import choose_impl
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.physics import which_overflowed
from gmijax.sim.robot_models import has_randomizer
from gmijax.sim.robots import BUFFERS, ROBOT_SETTINGS, playground_name
from gmijax.sim.tasks.settings import settings_from
from gmijax.sim.warp.kernels import compile_kernels
from gmijax.types import Array, PRNGKey, PyTree

REWARDS = "reward_config.scales."
"""Where Playground's configurations have the weights of the reward's terms."""


def make(
    name: str,
    *,
    impl: str = "auto",
    max_envs: int | None = None,
    rewards: Mapping[str, float] | None = None,
    settings: Mapping[str, float] | None = None,
) -> Env:
    """Makes one of Playground's environments.

    Args:
      name: one of `gmijax.config.env.ROBOTS` or of `mujoco_playground.registry.ALL_ENVS`.
      impl: `auto`, `jax` or `warp`.
      max_envs: most environments at once; MJX-Warp's buffer of contacts is for so many.
      rewards: weights of terms of the reward by name.
      settings: numbers by name: those of `gmijax.sim.robots`, or of Playground's configuration
        with dots between groups.

    Raises:
      ConfigError: an unknown name, a model that is not here, or one that Playground cannot make
        with the installed version of MuJoCo.
    """
    registry = import_playground().registry
    task = playground_name(name)
    if task not in registry.ALL_ENVS:
        raise ConfigError(_unknown(name, registry.ALL_ENVS))
    config = registry.get_default_config(task)
    label = label_of("playground", name)
    changed = _changed(name, flatten(config.to_dict()), rewards or {}, settings or {})
    if "impl" in config:
        changed["impl"], _ = choose_impl(impl, jax.default_backend(), label)
        changed = _buffers(registry, task, config, max_envs) | changed
    elif impl == "warp":
        raise ConfigError(f"physics.impl=warp: {name} has MJX-JAX only; allowed: auto, jax")
    theirs = attempt(f"env.name={name}", registry.load, task, config_overrides=changed)
    if changed.get("impl") == "warp":
        compile_kernels(theirs.mj_model)
    env = from_playground(theirs, name=label, episode_length=config.episode_length)
    if has_randomizer(task):
        draw = partial(_drawn, theirs, registry.get_domain_randomizer(task))
        env = env._replace(draw_models=draw)
    if task in ROBOTS.values():
        env = env._replace(command=lambda state: state.task.info["command"])
    return env._replace(max_envs=max_envs) if env.overflow is not None else env


def configuration(name: str, settings: Mapping[str, float]) -> dict[str, Any]:
    """Playground's configuration of a task, with what `settings` change in it; see `make`."""
    config = import_playground().registry.get_default_config(playground_name(name))
    changed = _changed(name, flatten(config.to_dict()), {}, settings)
    config.update_from_flattened_dict(changed)
    return config.to_dict()


def _drawn(theirs: Any, randomize: Callable[..., Any], keys: PRNGKey) -> dict[str, Array]:
    """The leaves of its model that Playground draws, by name: [N, ...] for `keys` [N]."""
    model, axes = randomize(theirs.mjx_model, jax.random.key_data(keys))
    leaves = _by_name(model)
    return {name: leaves[name] for name in _by_name(axes)}


def _by_name(tree: PyTree) -> dict[str, Any]:
    """The leaves by their names, with dots between groups."""
    named = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(at).removeprefix("."): leaf for at, leaf in named}


@contextmanager
def _with_leaves(theirs: Any, leaves: Mapping[str, Array] | tuple[()]) -> Iterator[None]:
    """Within it the model of `theirs` has these leaves, drawn for one environment.

    As in Playground's own wrapper. A tracer that stayed there would break what is traced next.
    """
    if not leaves:
        yield
        return
    nominal = theirs.mjx_model
    theirs._mjx_model = nominal.tree_replace(dict(leaves))
    try:
        yield
    finally:
        theirs._mjx_model = nominal


def _changed(
    name: str,
    defaults: Mapping[str, Any],
    rewards: Mapping[str, float],
    given: Mapping[str, float],
) -> dict[str, Any]:
    """What `rewards` and the `given` settings make of Playground's configuration.

    All of them by its keys, with dots between groups, and in its types.
    """
    if name in ROBOT_SETTINGS:
        changed = settings_from(ROBOT_SETTINGS[name], given).overrides()
    else:
        changed = {key: _converted(defaults, key, value) for key, value in given.items()}
    terms = [key.removeprefix(REWARDS) for key in defaults if key.startswith(REWARDS)]
    if unknown := [term for term in rewards if term not in terms]:
        hint = suggestion(unknown[0], terms) if terms else ""
        raise ConfigError(f"env.rewards.{unknown[0]}: {name} has no such term{hint}")
    return changed | {f"{REWARDS}{term}": weight for term, weight in rewards.items()}


def _converted(defaults: Mapping[str, Any], key: str, value: float) -> bool | int | float:
    """A number with the type that Playground's configuration has for it."""
    numbers = [name for name, number in defaults.items() if isinstance(number, int | float)]
    if key not in numbers:
        known = [name for name in numbers if not name.startswith(REWARDS)]
        raise ConfigError(f"env.settings.{key}: no such number{suggestion(key, known)}")
    kind = type(defaults[key])
    if kind is bool and value not in (0.0, 1.0):
        raise ConfigError(f"env.settings.{key}={value!r}: must be 0 or 1")
    if kind is int and not value.is_integer():
        raise ConfigError(f"env.settings.{key}={value!r}: must be a whole number")
    return kind(value)


def _buffers(registry: Any, task: str, config: Any, max_envs: int | None) -> dict[str, int]:
    """Sizes of MJX-Warp's buffers, by their keys in Playground's configuration.

    That for contacts is for all environments; theirs is for as many as they train with.
    """
    suites = ("locomotion", "manipulation", "dm_control_suite")
    suite = next((one for one in suites if task in getattr(registry, one).ALL_ENVS), None)
    if suite is None:
        return {}
    settings = importlib.import_module(f"mujoco_playground.config.{suite}_params")
    trained = settings.brax_ppo_config(task).num_envs
    contacts, rows = config.naconmax, config.njmax
    if (sizes := BUFFERS.get(task)) is not None:
        contacts, rows = trained * sizes.contacts_per_env, sizes.constraints_per_env
    growth = max(1.0, (max_envs or 0) / trained)
    return {"naconmax": math.ceil(contacts * growth), "njmax": rows}


def from_playground(theirs: Any, *, name: str, episode_length: int = 1000) -> Env:
    """An `MjxEnv`, without wrappers, as one of ours; see `brax_interface.adapt`.

    In MJX-Warp `theirs` is changed, see `without_warnings`.
    """
    is_warp = theirs.mjx_model.impl.value == "warp"
    env = adapt(
        without_warnings(theirs) if is_warp else theirs,
        name=name,
        episode_length=episode_length,
        mj_model=theirs.mj_model,
        qpos=lambda state: state.data.qpos,
        with_model=_with_leaves,
    )
    return _with_overflow(env) if is_warp else env


def _with_overflow(env: Env) -> Env:
    """`env` in MJX-Warp, which reports buffers that were too small in the last step."""

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        # MJX-Warp only ever adds bits.
        data = state.physics.data
        cleared = data.tree_replace({"_impl.overflow": jnp.zeros_like(data._impl.overflow)})
        return env.step(model, state._replace(physics=state.physics.replace(data=cleared)), action)

    def overflow(state: EnvState) -> Array:
        return which_overflowed(state.physics.data._impl.overflow)

    return env._replace(step=step, overflow=overflow)


def without_warnings(theirs: Any) -> Any:
    """`theirs` in MJX-Warp, changed not to print.

    Else there is a line for every environment and step that reaches the limit of the solver's
    iterations, which their models mean to reach.
    """
    theirs._mjx_model = theirs.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
    return theirs


def _unknown(name: str, names: tuple[str, ...]) -> str:
    close = close_name(name, names)
    hint = f"did you mean {close}?" if close else "see mujoco_playground.registry.ALL_ENVS"
    return f"env.name={name}: Playground has no such environment: {hint}"

"""The tasks by name. Importing this module loads neither jax nor mujoco: the controller does."""

from __future__ import annotations

import importlib
import importlib.util
import operator
import os
import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, overload

from gmijax.config import EnvConfig
from gmijax.config.env import ROBOTS, choice_of
from gmijax.config.schema import suggestion
from gmijax.errors import ConfigError
from gmijax.machine.xla_on_cpu import missing_on_cpu
from gmijax.sim import source
from gmijax.sim.robot_models import has_randomizer, require_models
from gmijax.sim.robots import ROBOT_SETTINGS, playground_name
from gmijax.sim.tasks.settings import CURRICULA, SETTINGS, settings_from

if TYPE_CHECKING:
    from gmijax.sim.interface import Env

TASKS: Mapping[str, str] = MappingProxyType(
    {name: f"gmijax.sim.tasks.{name}" for name in SETTINGS}
)
"""Name of each of our tasks -> its module, with `make(*, impl, max_envs, rewards, settings)`,
which returns an `Env`, `TERMS`, `OBS_TERMS` and `DEFAULT_EPISODE_LENGTH`."""

SUITES: Mapping[str, str] = MappingProxyType(
    {
        "brax": "gmijax.sim.adapters.brax",
        "playground": "gmijax.sim.adapters.playground",
        "custom": "gmijax.sim.adapters.custom",
    }
)
"""Whose tasks there are beside ours -> module with `make(name, *, impl, max_envs) -> Env`; those
whose tasks have them take `rewards` and `settings` too."""

_PACKAGES: Mapping[str, str] = MappingProxyType(
    {"brax": "brax", "playground": "mujoco_playground"}
)


_NONE: Mapping[str, float] = MappingProxyType({})


def task_names() -> tuple[str, ...]:
    """The names of our own tasks, sorted."""
    return tuple(sorted(TASKS))


def require_task(name: str, suite: str = "gmijax") -> None:
    """Raises ConfigError unless `name` may be a task of `suite`; needs no jax.

    Which names a package has is known when it is imported, and that is left to the GMIs.
    """
    package = _PACKAGES.get(suite)
    if package is not None and importlib.util.find_spec(package) is None:
        raise ConfigError(
            f"env={choice_of(suite, name)}: needs the package {package} "
            f"(pip install 'gmijax[{suite}]')"
        )
    if suite == "custom" or (suite == "gmijax" and source.names_file(name)):
        source.split(name)
    if suite == "gmijax" and name not in TASKS:
        raise ConfigError(f"env={name}: unknown task{suggestion(name, (*TASKS, *ROBOTS))}")


def require_own(env: EnvConfig) -> None:
    """Raises ConfigError unless it is one of our tasks: they alone run without jax."""
    if env.suite != "gmijax":
        raise ConfigError(
            f"env={env.label}: only our own tasks are played without jax: {', '.join(TASKS)}; "
            "gmijax play films others"
        )


def missing_of(choice: str) -> str | None:
    """What a value of `env=` needs that is not on this machine, in words; None: nothing."""
    try:
        if choice in ROBOTS:
            require_task(choice, "playground")
            require_models(playground_name(choice), choice)
        elif choice in _PACKAGES:
            require_task("", choice)
    except ConfigError as error:
        return str(error).partition(": ")[2]
    return None


def require_env(env: EnvConfig) -> None:
    """Raises ConfigError unless the task of a configuration may be had so; needs no jax."""
    require_task(str(env.name), env.suite)
    has_curriculum = env.curriculum == "on"
    _require_changes(str(env.name), env.suite, env.rewards, env.settings, has_curriculum)
    if env.suite == "playground":
        _require_randomizer(env)
        require_models(playground_name(str(env.name)), env.label)


def draws_models(env: EnvConfig) -> bool:
    """Whether there is anything that `env.randomize` could draw."""
    brings = env.suite == "playground" and has_randomizer(playground_name(str(env.name)))
    return bool(env.randomization) or brings


def _require_randomizer(env: EnvConfig) -> None:
    """Raises ConfigError for a randomisation that a task of Playground cannot have."""
    if env.randomization:
        raise ConfigError(
            f"env.randomization.{next(iter(env.randomization))}: not with env={env.label}; tasks "
            "of Playground bring what they draw, or draw nothing"
        )
    if env.randomize == "episode":
        raise ConfigError(
            f"env.randomize=episode: not with env={env.label}, whose episodes all begin with the "
            "first start of their environment; allowed: off, on"
        )
    if env.randomize == "on" and not draws_models(env):
        raise ConfigError(
            f"env.randomize=on: Playground has no randomisation for {env.label}; allowed: off"
        )


def _require_changes(
    name: str,
    suite: str,
    rewards: Mapping[str, float],
    settings: Mapping[str, float],
    curriculum: bool,
) -> None:
    """Raises ConfigError for what a task cannot have. Terms are known to its module alone."""
    if curriculum and suite != "custom" and not (suite == "gmijax" and name in CURRICULA):
        raise ConfigError(
            f"env.curriculum=on: {name} has none; allowed: {', '.join(CURRICULA)} and "
            "env=PATH.py:FUNCTION"
        )
    if suite == "gmijax":
        settings_from(SETTINGS[name], settings)
    elif suite == "playground" and name in ROBOTS:
        settings_from(ROBOT_SETTINGS[name], settings)
    elif suite == "brax":
        for group, given in (("rewards", rewards), ("settings", settings)):
            if given:
                raise ConfigError(
                    f"env.{group}.{next(iter(given))}: not with env=brax, whose environments are "
                    "taken as they are; allowed: our tasks, env=playground and "
                    "env=PATH.py:FUNCTION"
                )


@overload
def make_env(
    name: str,
    *,
    suite: str = ...,
    impl: str = ...,
    episode_length: int | None = ...,
    max_envs: int | None = ...,
    source_sha256: str | None = ...,
    rewards: Mapping[str, float] = ...,
    settings: Mapping[str, float] = ...,
    curriculum: bool = ...,
    api: Literal["gmijax"] = ...,
) -> Env: ...


@overload
def make_env(
    name: str,
    *,
    suite: str = ...,
    impl: str = ...,
    episode_length: int | None = ...,
    max_envs: int | None = ...,
    source_sha256: str | None = ...,
    rewards: Mapping[str, float] = ...,
    settings: Mapping[str, float] = ...,
    curriculum: bool = ...,
    api: Literal["brax"],
) -> Any: ...


def make_env(
    name: str,
    *,
    suite: str = "gmijax",
    impl: str = "auto",
    episode_length: int | None = None,
    max_envs: int | None = None,
    source_sha256: str | None = None,
    rewards: Mapping[str, float] = _NONE,
    settings: Mapping[str, float] = _NONE,
    curriculum: bool = False,
    api: Literal["gmijax", "brax"] = "gmijax",
) -> Any:
    """Makes a task, with its time limit.

    Args:
      name: one of `task_names()` or of `gmijax.config.env.ROBOTS`, a name that `suite` knows, or
        `PATH.py:FUNCTION`.
      suite: whose task: `gmijax`, `brax`, `playground` or `custom`.
      impl: MJX implementation, `auto`, `jax` or `warp`.
      episode_length: steps after which an episode is truncated; None: the task's own.
      max_envs: upper bound of environments stepped at once, for tasks of users that need one;
        None for no limit.
      source_sha256: digest of a custom task's file, which is not executed with another one.
      rewards: weights of terms of the reward by name, instead of the task's own.
      settings: numbers of the task by name (`gmijax.sim.tasks.settings`), as `rewards`.
      curriculum: whether an environment's episodes get harder as they succeed.
      api: `gmijax` for an `Env`, `brax` for a `brax.envs.Env` without a time limit, as Brax's
        wrappers want it.

    Raises:
      ConfigError: an unknown name of a task, a term or a setting, a package or implementation
        that cannot be had, a length below 1, or a length for `brax`, whose `EpisodeWrapper`
        takes it; or `jax_enable_x64` is on.
    """
    if not isinstance(name, str):
        raise ConfigError(f"name={name!r}: expected the name of a task")
    _require_api(api, episode_length)
    if episode_length is not None:
        episode_length = whole_number("env.episode_length", episode_length)
    if max_envs is not None:
        max_envs = whole_number("max_envs", max_envs)
    suite = _suite_of(name, suite)
    changes: dict[str, Any] = {"rewards": rewards, "settings": settings, "curriculum": curriculum}
    from gmijax.devices import require_32_bit

    require_32_bit("this process")
    noted = {"source_sha256": source_sha256} if suite == "custom" else {}
    env = _make(name, suite, changes, impl=impl, max_envs=max_envs, **noted)
    if api == "brax":
        warn_on_cpu(env)
        return importlib.import_module("gmijax.sim.adapters.to_brax").BraxEnv(env)
    from gmijax.sim.interaction import time_limit

    return time_limit(env, episode_length or env.spec.episode_length)


def _require_api(api: str, episode_length: int | None) -> None:
    if api not in ("gmijax", "brax"):
        raise ConfigError(f"api={api}: expected one of gmijax, brax")
    if api == "brax":
        if episode_length is not None:
            raise ConfigError("episode_length: give it to Brax's EpisodeWrapper with api=brax")
        require_task("", "brax")


def _suite_of(name: str, suite: str) -> str:
    """The suite of a task that is named without it."""
    if suite == "gmijax" and ".py:" in name:
        return "custom"
    return "playground" if suite == "gmijax" and name in ROBOTS else suite


def warn_on_cpu(env: Env) -> None:
    """Warns if this process steps MJX on a CPU with XLA as it comes; GMIs set what it needs."""
    import jax

    if env.mj_model is None or jax.default_backend() != "cpu":
        return
    if missing := missing_on_cpu(os.environ, len(os.sched_getaffinity(0))):
        wanted = " ".join(f"{name}='{value}'" for name, value in missing.items())
        warnings.warn(
            f"physics on this CPU is far slower, or stops, unless Python is started with {wanted} "
            "in its environment",
            stacklevel=3,
        )


def whole_number(key: str, value: Any) -> int:
    """`value` as an int of at least 1.

    Raises:
      ConfigError: it is none.
    """
    try:
        number = operator.index(value)
    except TypeError:
        raise ConfigError(f"{key}={value!r}: expected a whole number") from None
    if number < 1:
        raise ConfigError(f"{key}={number}: must be at least 1")
    return number


def _make(name: str, suite: str, changes: Mapping[str, Any], **options: Any) -> Env:
    """A task without its time limit; it gets those `changes` that are any."""
    if suite not in ("gmijax", *SUITES):
        raise ConfigError(f"suite={suite}: expected one of gmijax, {', '.join(SUITES)}")
    require_task(name, suite)
    _require_changes(name, suite, **changes)
    options |= {key: value for key, value in changes.items() if value}
    if suite == "gmijax":
        from gmijax.sim.traced import traced_once

        env: Env = traced_once(importlib.import_module(TASKS[name]).make(**options))
    else:
        env = importlib.import_module(SUITES[suite]).make(name, **options)
    if changes["curriculum"] and env.next_episode is None:
        raise ConfigError(f"env.curriculum=on: {env.spec.name} has no next_episode to carry it on")
    return env

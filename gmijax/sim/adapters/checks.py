"""Is this an environment? Asked when one comes from outside, before anything is compiled for long.

Reset and step are traced, not run: that takes a second or two, and gives shapes and dtypes.
"""

from __future__ import annotations

import numbers
import operator
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.errors import ConfigError, gist_of, with_type
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.types import PyTree

_FOUND: Final = "imports are found beside the task, among installed packages and in PYTHONPATH"
"""Where a task's imports are looked for: the working directory is not among them."""


def check_env(env: Any, what: str) -> Env:
    """The environment, with sizes that are Python's integers, as files and programs want them.

    Raises:
      ConfigError: `env` is none; one line, which names it by `what`.
    """
    if not isinstance(env, Env):
        raise ConfigError(f"{what}: expected a gmijax.sim.interface.Env, got {_kind(env)}")
    if not isinstance(env.spec, EnvSpec):
        raise ConfigError(f"{what}: spec: expected an EnvSpec, got {_kind(env.spec)}")
    env = env._replace(spec=_with_plain_sizes(env.spec, what))
    spec = env.spec
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((spec.action_size,), jnp.float32)
    state = attempt(f"{what}: reset", jax.eval_shape, env.reset, env.model, key)
    _check_state(env, state, key, f"{what}: reset")
    moved = attempt(f"{what}: step", jax.eval_shape, env.step, env.model, state, action)
    _check_state(env, moved, key, f"{what}: step")
    if change := _change(state, moved):
        raise ConfigError(f"{what}: step must keep all shapes and dtypes, but {change}")
    if env.next_episode is not None:
        again = attempt(
            f"{what}: next_episode", jax.eval_shape, env.next_episode, env.model, moved
        )
        if change := _change(state, again):
            raise ConfigError(f"{what}: next_episode must give what reset does, but {change}")
    _check_qpos(env, state, what)
    return env


def _with_plain_sizes(spec: EnvSpec, what: str) -> EnvSpec:
    """Numpy's integers are welcome: `mj_model.sensor_dim.sum()` is one."""
    for name in ("obs_size", "action_size", "episode_length"):
        size = _integer(getattr(spec, name))
        if size is None or size < 1:
            raise ConfigError(
                f"{what}: spec.{name}={getattr(spec, name)!r}: must be an integer of at least 1"
            )
        spec = spec._replace(**{name: size})
    seen = None if spec.actor_obs_size is None else _integer(spec.actor_obs_size)
    if spec.actor_obs_size is not None and (seen is None or not 1 <= seen <= spec.obs_size):
        raise ConfigError(
            f"{what}: spec.actor_obs_size={spec.actor_obs_size!r}: must be an integer from 1 to "
            f"spec.obs_size={spec.obs_size}, or None"
        )
    _require_duration(spec.control_dt_s, what)
    return spec._replace(actor_obs_size=seen)


def _require_duration(seconds: Any, what: str) -> None:
    """Films, the viewer and robots divide by it; what Brax does not say is NaN."""
    if not isinstance(seconds, numbers.Real) or seconds <= 0:
        raise ConfigError(
            f"{what}: spec.control_dt_s={seconds!r}: must be a number of seconds greater than 0"
        )


def _integer(value: Any) -> int | None:
    try:
        return operator.index(value)
    except TypeError:
        return None


def check_start(env: Env, what: str) -> None:
    """Raises ConfigError unless one reset, which is run, gives finite numbers in bounds."""
    state = attempt(f"{what}: reset", jax.jit(env.reset), env.model, jax.random.key(0))
    for at, leaf in jax.tree.leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and not np.isfinite(leaf).all():
            raise ConfigError(f"{what}: reset gives numbers that are not finite in {_path(at)}")
    largest = float(jnp.max(jnp.abs(state.obs)))
    if largest >= env.spec.max_abs_obs:
        raise ConfigError(
            f"{what}: reset gives an observation of {largest:g}, and spec.max_abs_obs="
            f"{env.spec.max_abs_obs:g} would end the environment"
        )


def attempt(what: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Calls the user's code.

    Raises:
      ConfigError: it raised anything; the line has the innermost location, the cause the rest.
    """
    try:
        return function(*arguments, **named)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        found = f"; {_FOUND}" if isinstance(error, ModuleNotFoundError) else ""
        message = with_type(type(error).__name__, gist_of(str(error)))
        raise ConfigError(f"{what} fails: {message}{_line_of(error)}{found}") from error


def _line_of(error: BaseException) -> str:
    if isinstance(error, SyntaxError):
        return ""  # Its message has the line.
    ours = str(Path(__file__).parents[2])
    outside = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((ours, "<frozen"))
        and "/site-packages/" not in frame.filename
    ]
    return f" ({outside[-1].filename}:{outside[-1].lineno})" if outside else ""


def _check_state(env: Env, state: Any, key: jax.ShapeDtypeStruct, what: str) -> None:
    if not isinstance(state, EnvState):
        raise ConfigError(f"{what} must return an EnvState, got {_kind(state)}")
    spec = env.spec
    scalar, flag = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((), jnp.bool_)
    wanted = {
        "obs": jax.ShapeDtypeStruct((spec.obs_size,), jnp.float32),
        "reward": scalar,
        "reward_terms": dict.fromkeys(spec.reward_terms, scalar),
        "metrics": dict.fromkeys(spec.metrics, scalar),
        "terminated": flag,
        "truncated": flag,
        "steps": jax.ShapeDtypeStruct((), jnp.int32),
        "key": key,
    }
    if change := _change(wanted, {name: getattr(state, name) for name in wanted}):
        raise ConfigError(f"{what} does not give what spec says: {change}")


def _check_qpos(env: Env, state: EnvState, what: str) -> None:
    shape = attempt(f"{what}: qpos", jax.eval_shape, env.qpos, state).shape
    model = env.mj_model
    known = [] if model is None else [(model.nq,), (model.nq + 7 * model.nmocap,)]
    if len(shape) != 1 or (known and shape not in known):
        wanted = f"{known[0]}" if known else "a vector"
        raise ConfigError(f"{what}: qpos has shape {shape}, not {wanted}")


def _change(before: PyTree, after: PyTree) -> str:
    """The first leaf that is different, in words; empty where none is."""
    old, new = (
        {_path(at): f"{leaf.dtype}{list(leaf.shape)}" for at, leaf in jax.tree.leaves_with_path(t)}
        for t in (before, after)
    )
    for at in sorted(old.keys() | new.keys()):
        was, now = old.get(at), new.get(at)
        if was != now:
            return f"{at} is {now or 'missing'}, not {was or 'there'}"
    same = jax.tree.structure(before) == jax.tree.structure(after)
    return "" if same else "its nesting is another one"


def _path(at: Any) -> str:
    return jax.tree_util.keystr(at, simple=True, separator=".")


def _kind(value: Any) -> str:
    return type(value).__name__

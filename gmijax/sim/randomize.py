"""Environments as a configuration describes them, and domain randomisation: a model for each.

The draws of an environment depend on the seed and on its number in the whole job only, so k GMIs
with n environments simulate what one with k x n does, and a resumed job finds its environments
again without having saved them. Only the leaves that are drawn, and what follows from them, get a
leading axis [N].
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt

from gmijax.config import EnvConfig
from gmijax.config.env import NEVER_ZERO, RANDOMIZED_LEAVES, LeafRange
from gmijax.errors import ConfigError
from gmijax.sim.interaction import action_repeat, observation_history
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.registry import make_env
from gmijax.sim.wrappers import env_keys
from gmijax.types import Array, PRNGKey, PyTree

Floats = npt.NDArray[np.float32]
Ids = npt.NDArray[np.intp]
Leaves = dict[str, Floats]

POOL = 1024
"""Models of which `env.randomize=episode` takes one for every episode."""

_STREAM = zlib.crc32(b"domain randomisation")
"""Folded into the job's key. Small numbers are taken: `split` hands out what they would give."""

_MASS_LEAVES = ("body_mass", "dof_armature")
"""Leaves on which the constants depend that `mj_setConst` computes."""

_CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0")


def make_envs(config: EnvConfig, impl: str, *, seed: int, first_env: int, num_envs: int) -> Env:
    """The task with the wrappers and the randomisation that the configuration asks for.

    Args:
      config: task and randomisation.
      impl: MJX implementation, decided.
      seed: of the run.
      first_env: number of the first of these environments in the whole job.
      num_envs: N.
    """
    env = make_env(
        str(config.name),
        suite=config.suite,
        impl=impl,
        episode_length=config.episode_length,
        max_envs=num_envs,
        source_sha256=config.source_sha256,
        rewards=config.rewards,
        settings=config.settings,
        curriculum=config.curriculum == "on",
    )
    env = observation_history(action_repeat(env, config.action_repeat), config.history)
    ranges = config.randomization
    if config.randomize == "episode":
        return randomized_by_episode(env, ranges, seed=seed, num_models=POOL)
    if config.randomize == "off":
        return env
    return randomized(env, ranges, seed=seed, first_env=first_env, num_envs=num_envs)


def randomized(
    env: Env, ranges: Mapping[str, LeafRange], *, seed: int, first_env: int, num_envs: int
) -> Env:
    """The task with a model of its own for each of N environments.

    Args:
      env: the task, whose model all environments share.
      ranges: what to draw, by leaf; empty: what the task itself draws.
      seed: the job's seed, the same on every GMI.
      first_env: global number of this GMI's first environment.
      num_envs: N; the result is for exactly so many environments.

    Raises:
      ConfigError: a task without a model of MJX, a name that the model does not have, a draw that
        could not change anything, or values that no body, joint or contact can have.
    """
    from mujoco import mjx  # A second to import, which tasks without it need not pay.

    key = jax.random.fold_in(jax.random.key(seed), _STREAM)
    keys = env_keys(key, first_env, num_envs)
    if not ranges and env.draw_models is not None:
        model = env.draw_models(keys)
        return env._replace(model=model, model_axes=jax.tree.map(lambda _: 0, model))
    if not isinstance(env.model, mjx.Model):
        raise ConfigError(f"env.randomize=on: {env.spec.name} has no model of MJX to draw")
    leaves: Leaves = {}
    for leaf, drawn in ranges.items():
        leaves |= _with_dependents(env.mj_model, leaf, _drawn(env, keys, leaf, drawn))
    if any(leaf in ranges for leaf in _MASS_LEAVES):
        leaves |= _constants(env.mj_model, leaves, num_envs)
    axes = jax.tree.map(lambda _: None, env.model).tree_replace(dict.fromkeys(leaves, 0))
    model = env.model.tree_replace(
        {name: jnp.asarray(v, jnp.float32) for name, v in leaves.items()}
    )
    return env._replace(model=model, model_axes=axes)


class Drawn(NamedTuple):
    """A task's memory, and which model its environment has in this episode, [] int32."""

    task: PyTree
    number: Array


def randomized_by_episode(
    env: Env, ranges: Mapping[str, LeafRange], *, seed: int, num_models: int
) -> Env:
    """The task with another model in every episode, one of `num_models` that all GMIs draw alike.

    The models are drawn beforehand, because MuJoCo in C computes what follows from their masses.
    An environment takes its own out of the pool in every step.

    Args, Raises: as `randomized`.
    """
    pool = randomized(env, ranges, seed=seed, first_env=0, num_envs=num_models)
    per_model = [axis is not None for axis in _leaves(pool.model_axes)]

    def own(model: PyTree, number: Array) -> PyTree:
        leaves, tree = jax.tree.flatten(model, is_leaf=_is_none)
        chosen = zip(leaves, per_model, strict=True)
        return jax.tree.unflatten(tree, [leaf[number] if per else leaf for leaf, per in chosen])

    def draw(key: PRNGKey) -> tuple[PRNGKey, Array]:
        key, drawn = jax.random.split(key)
        return key, jax.random.randint(drawn, (), 0, num_models)

    def reset(model: PyTree, key: PRNGKey) -> EnvState:
        key, number = draw(key)
        state = env.reset(own(model, number), key)
        return state._replace(task=Drawn(state.task, number))

    def step(model: PyTree, state: EnvState, action: Array) -> EnvState:
        before, number = state._replace(task=state.task.task), state.task.number
        after = env.step(own(model, number), before, action)
        return after._replace(task=Drawn(after.task, number))

    again = env.next_episode

    def next_episode(model: PyTree, ended: EnvState) -> EnvState:
        assert again is not None
        key, number = draw(ended.key)
        state = again(own(model, number), ended._replace(task=ended.task.task, key=key))
        return state._replace(task=Drawn(state.task, number))

    return env._replace(
        model=pool.model,
        reset=reset,
        step=step,
        next_episode=None if again is None else next_episode,
    )


def _is_none(leaf: Any) -> bool:
    return leaf is None


def _leaves(tree: PyTree) -> list[Any]:
    return jax.tree.leaves(tree, is_leaf=_is_none)


def _drawn(env: Env, keys: PRNGKey, leaf: str, drawn: LeafRange) -> Floats:
    """The leaf of all environments [N, ...]."""
    rows, columns = _rows(env, leaf, drawn.names), _COLUMNS.get(leaf)
    nominal = np.asarray(getattr(env.mj_model, leaf), np.float32)
    values = nominal[rows] if columns is None else nominal[rows, columns]
    _check_values(env, leaf, drawn, values)
    # From the name, so that an environment keeps its masses when its friction is drawn too.
    stream = zlib.crc32(leaf.encode())
    shape = (len(rows) if drawn.draw == "each" else 1,)
    low, high = drawn.range
    numbers = np.asarray(
        jax.vmap(lambda key: jax.random.uniform(key, shape, minval=low, maxval=high))(
            jax.vmap(lambda key: jax.random.fold_in(key, stream))(keys)
        )
    ).reshape(len(keys), -1, *(1,) * (values.ndim - 1))
    changed = np.tile(nominal, (len(keys), *(1,) * nominal.ndim))
    where = (slice(None), rows) if columns is None else (slice(None), rows, columns)
    changed[where] = _operate(drawn.operation, values, numbers)
    return changed


def _operate(operation: str, values: Floats, numbers: Floats) -> Floats:
    if operation == "scale":
        return values * numbers
    return values + numbers if operation == "add" else np.zeros_like(values) + numbers


def _with_dependents(mj_model: mujoco.MjModel, leaf: str, values: Floats) -> Leaves:
    """The leaf [N, ...], and leaves that mean nothing without it, changed to fit."""
    if leaf == "body_mass":
        # The same shape and a different density: inertias are proportional to the mass.
        mass = np.asarray(mj_model.body_mass, np.float32)
        ratio = np.divide(values, mass, out=np.ones_like(values), where=mass > 0)
        return {leaf: values, "body_inertia": ratio[..., None] * mj_model.body_inertia}
    if leaf == "actuator_gainprm":
        return {leaf: values, "actuator_biasprm": _servo_bias(mj_model, values)}
    return {leaf: values}


def _servo_bias(mj_model: mujoco.MjModel, gain: Floats) -> Floats:
    """Biases [N, nu, 10] with which servos still pull to their set points.

    A servo's force is gain x control + bias x position (or velocity) with bias = -gain.
    """
    bias = np.tile(np.asarray(mj_model.actuator_biasprm, np.float32), (len(gain), 1, 1))
    for actuator in range(mj_model.nu):
        nominal = mj_model.actuator_gainprm[actuator, 0]
        for column in (1, 2):
            if nominal and mj_model.actuator_biasprm[actuator, column] == -nominal:
                bias[:, actuator, column] = -gain[:, actuator, 0]
                break
    return bias


def _constants(mj_model: mujoco.MjModel, leaves: Leaves, num_envs: int) -> Leaves:
    """What MuJoCo derives from masses and armatures when it compiles a model, [N, ...] each.

    Constraints are as stiff as these say. 20 to 90 microseconds an environment.
    """
    scratch = copy.copy(mj_model)
    data = mujoco.MjData(scratch)
    given = [name for name in ("body_mass", "body_inertia", "dof_armature") if name in leaves]
    rows: dict[str, list[Any]] = {name: [] for name in _CONSTANTS if getattr(mj_model, name).size}
    for index in range(num_envs):
        for name in given:
            getattr(scratch, name)[:] = leaves[name][index]
        mujoco.mj_setConst(scratch, data)
        for name, values in rows.items():
            values.append(getattr(scratch, name).copy())
    return {name: np.asarray(values, np.float32) for name, values in rows.items()}


def _rows(env: Env, leaf: str, names: Sequence[str] | None) -> Ids:
    """The rows of a leaf that belong to elements `names`."""
    mj_model, kind = env.mj_model, RANDOMIZED_LEAVES[leaf]
    count, element = _ELEMENTS[kind]
    if names is None:
        ids = np.arange(getattr(mj_model, count))
        if kind == "bodies":  # The world and mere frames have no mass to change.
            ids = ids[mj_model.body_mass > 0]
        elif kind == "joints":  # A free joint is no hinge that could wear.
            ids = ids[mj_model.jnt_type != mujoco.mjtJoint.mjJNT_FREE]
    else:
        _check_names(env, leaf, names)
        ids = np.array([getattr(mj_model, element)(name).id for name in names])
    return np.flatnonzero(np.isin(mj_model.dof_jntid, ids)) if leaf.startswith("dof_") else ids


def _check_names(env: Env, leaf: str, names: Sequence[str]) -> None:
    count, element = _ELEMENTS[RANDOMIZED_LEAVES[leaf]]
    get, number = getattr(env.mj_model, element), getattr(env.mj_model, count)
    known = sorted(filter(None, (get(i).name for i in range(number))))
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(
            f"env.randomization.{leaf}.names={unknown[0]}: {env.spec.name} has no such name; "
            f"allowed: {', '.join(known)}"
        )


def _check_values(env: Env, leaf: str, drawn: LeafRange, values: Floats) -> None:
    key, task = f"env.randomization.{leaf}", env.spec.name
    if not values.size or (drawn.operation == "scale" and not values.any()):
        raise ConfigError(f"{key}: {task} has nothing but zeros there, which no draw would change")
    if leaf == "body_mass" and not values.all():
        raise ConfigError(f"{key}: names a body of {task} without mass")
    if drawn.operation != "scale" and leaf == "dof_frictionloss" and not values.all():
        raise ConfigError(f"{key}: MJX keeps joints of {task} without friction free of it")
    least = values.min() + drawn.range[0]
    if drawn.operation == "add" and (least < 0 or (leaf in NEVER_ZERO and least == 0)):
        raise ConfigError(
            f"{key}.range={list(drawn.range)}: {task} has values as low as {values.min():g}, "
            f"which would become {least:g}"
        )


_ELEMENTS: Mapping[str, tuple[str, str]] = {
    "bodies": ("nbody", "body"),
    "geoms": ("ngeom", "geom"),
    "contact pairs": ("npair", "pair"),
    "joints": ("njnt", "joint"),
    "actuators": ("nu", "actuator"),
}
"""What names name -> how MuJoCo calls their number, and one of them."""

_COLUMNS: Mapping[str, slice] = {
    "geom_friction": slice(0, 1),
    "pair_friction": slice(0, 2),
    "actuator_gainprm": slice(0, 1),
}
"""The columns that a draw changes, all by the same number: sliding friction, and the gain."""

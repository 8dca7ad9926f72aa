"""Domain randomisation: the draws, and that every environment then moves as its own model says."""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled_tasks import on_device

from gmijax.cli.compose import compose
from gmijax.config import EnvConfig
from gmijax.config.env import RANDOMIZED_LEAVES, LeafRange
from gmijax.config.schema import from_dict
from gmijax.errors import ConfigError
from gmijax.sim import episode, physics, randomize, wrappers
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.randomize import make_envs, randomized, randomized_by_episode
from gmijax.sim.warp.batch import MODEL_LEAVES
from gmijax.sim.wrappers import env_keys, training_env

NUM_ENVS = 4
STEPS = 20
DERIVED = (".body_subtreemass", ".body_invweight0", ".dof_invweight0")
# Something for every leaf. The cones are round: MJX lays the edges of pyramids otherwise than C.
SLEDGE = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" iterations="20"
          ls_iterations="20"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="sledge" pos="0 0 0.099">
      <joint name="along" type="slide" axis="1 0 0" damping="0.5" armature="1"/>
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom name="runner" type="sphere" size="0.1" mass="2"/>
      <body name="arm" pos="0 0 0.1">
        <joint name="elbow" axis="0 1 0" damping="0.1" frictionloss="0.05" stiffness="1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0.1" mass="0.5" contype="0"
              conaffinity="0"/>
        <body name="frame"/>
      </body>
    </body>
    <body name="ball" pos="1 0 0.099">
      <joint name="ball_along" type="slide" axis="1 0 0"/>
      <joint name="ball_up" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact><pair name="ball" geom1="floor" geom2="ball" friction="0.7 0.7"/></contact>
  <actuator>
    <motor name="pull" joint="along" gear="5"/>
    <position name="elbow" joint="elbow" kp="3" kv="0.2"/>
  </actuator>
</mujoco>
"""
STARTS = {"qvel": [1.0, 0.0, -2.0, 2.0, 0.0], "ctrl": [1.0, -0.5]}
ALL_LEAVES = {leaf: LeafRange(operation="scale", range=(0.5, 1.5)) for leaf in RANDOMIZED_LEAVES}


def sledge(impl: str = "jax") -> Env:
    sim = physics.from_mj_model(
        mujoco.MjModel.from_xml_string(SLEDGE), impl=impl, substeps=1, max_envs=NUM_ENVS
    )
    spec = EnvSpec("sledge", 5, 2, sim.control_dt_s, 100, ("nothing",))

    def reset(model: Any, key: jax.Array) -> EnvState:
        del model
        qpos = jnp.asarray(sim.mj_model.qpos0, jnp.float32)
        start = sim.start(qpos, jnp.array(STARTS["qvel"]))
        return episode.begin(spec, start, (), start.qvel, key)

    def step(model: Any, state: EnvState, action: jax.Array) -> EnvState:
        moved, _ = sim.step(model, state.physics, action)
        reward = jnp.zeros(()), {"nothing": jnp.zeros(())}
        return episode.advance(state, moved, (), moved.qvel, reward, jnp.zeros((), bool))

    return Env(spec, sim.model, reset, step, sim.mj_model, lambda s: s.physics.qpos, sim.max_envs)


def drawn(env: Env, seed: int = 0, first_env: int = 0, num_envs: int = NUM_ENVS, **ranges: Any):
    """The leaves of the randomised model that differ from the shared one."""
    leaves = {leaf: LeafRange(**values) for leaf, values in ranges.items()} or ALL_LEAVES
    model = randomized(env, leaves, seed=seed, first_env=first_env, num_envs=num_envs).model
    return {
        jax.tree_util.keystr(path): np.asarray(new)
        for (path, new), old in zip(
            jax.tree_util.tree_leaves_with_path(model), jax.tree.leaves(env.model), strict=True
        )
        if np.shape(new) != np.shape(old)
    }


@pytest.fixture(scope="module")
def env() -> Env:
    return sledge()


def test_mujoco_warp_gets_all_fields_that_are_drawn(env: Env):
    assert {leaf.removeprefix(".") for leaf in drawn(env)} <= set(MODEL_LEAVES)


def test_only_what_is_drawn_and_the_constants_of_such_a_model_are_per_environment(env: Env):
    assert set(drawn(env, dof_damping={"operation": "scale", "range": (0.5, 2.0)})) == {
        ".dof_damping"
    }
    with_mass = drawn(env, body_mass={"operation": "scale", "range": (0.5, 2.0)})
    assert set(with_mass) == {".body_mass", ".body_inertia", *DERIVED}
    for index in range(NUM_ENVS):
        mj_model = model_of_env(env, with_mass, index)
        for name in DERIVED:
            expected = getattr(mj_model, name.removeprefix("."))
            np.testing.assert_allclose(with_mass[name][index], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("operation", "low", "high"), [("scale", 0.5, 0.6), ("add", -0.3, 0.4), ("set", 3.0, 4.0)]
)
@pytest.mark.parametrize("draw", ["each", "shared"])
def test_draws_are_in_range_and_differ_by_environment(
    env: Env, operation: str, low: float, high: float, draw: str
):
    leaves = drawn(
        env,
        num_envs=200,
        body_mass={"operation": operation, "range": (low, high), "draw": draw},
    )
    nominal = env.mj_model.body_mass
    mass = leaves[".body_mass"]
    moved = nominal > 0
    np.testing.assert_array_equal(mass[:, ~moved], 0.0)
    numbers = {
        "scale": mass[:, moved] / nominal[moved],
        "add": mass[:, moved] - nominal[moved],
        "set": mass[:, moved],
    }[operation]
    assert low - 1e-6 <= numbers.min() < low + 0.1 * (high - low)
    assert high + 1e-6 >= numbers.max() > high - 0.1 * (high - low)
    assert len(np.unique(numbers[:, 0])) == 200
    same = np.isclose(numbers, numbers[:, :1], atol=1e-6).all(axis=1)
    assert same.all() if draw == "shared" else not same.any()
    ratio = mass[:, moved] / nominal[moved]
    inertia = leaves[".body_inertia"][:, moved]
    np.testing.assert_allclose(inertia, ratio[..., None] * env.mj_model.body_inertia[moved], 1e-5)


def test_only_named_elements_change(env: Env):
    gain = drawn(
        env, actuator_gainprm={"operation": "set", "range": (7.0, 8.0), "names": ("elbow",)}
    )
    kp = gain[".actuator_gainprm"][:, 1, 0]
    assert ((kp >= 7.0) & (kp <= 8.0)).all()
    # The servo still pulls to its set point, and its damping stays.
    np.testing.assert_array_equal(gain[".actuator_biasprm"][:, 1, 1], -kp)
    np.testing.assert_allclose(gain[".actuator_biasprm"][:, 1, 2], -0.2)
    np.testing.assert_array_equal(gain[".actuator_gainprm"][:, 0], [[1.0] + [0.0] * 9] * NUM_ENVS)
    damping = drawn(env, dof_damping={"operation": "scale", "range": (2, 3), "names": ("along",)})
    changed = damping[".dof_damping"] / np.maximum(env.mj_model.dof_damping, 1e-9)
    assert (changed[:, 0] >= 2.0).all()
    np.testing.assert_allclose(damping[".dof_damping"][:, 1:], [env.mj_model.dof_damping[1:]] * 4)


def test_neither_the_split_over_gmis_nor_other_leaves_change_the_draws(env: Env):
    whole = drawn(env, seed=3, num_envs=6)
    parts = [drawn(env, seed=3, first_env=first, num_envs=3) for first in (0, 3)]
    other = drawn(env, seed=4, num_envs=6)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, np.concatenate([part[name] for part in parts]))
        assert not np.array_equal(values, other[name])
    # A leaf keeps its draws when others are drawn too.
    mass = {"operation": "scale", "range": (0.5, 1.5)}
    alone = drawn(env, seed=3, num_envs=6, body_mass=mass)[".body_mass"]
    np.testing.assert_array_equal(alone, whole[".body_mass"])


def model_of_env(env: Env, leaves: dict[str, np.ndarray], index: int) -> mujoco.MjModel:
    """A model of MuJoCo in C with the numbers of one environment and constants made of them."""
    mj_model = copy.copy(env.mj_model)
    for name, values in leaves.items():
        if name not in DERIVED:
            getattr(mj_model, name.removeprefix("."))[:] = values[index]
    mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
    return mj_model


@pytest.mark.parametrize("impl", ["jax", pytest.param("warp", marks=pytest.mark.slow)])
def test_every_environment_moves_as_mujoco_in_c_says(impl: str):
    if impl == "warp":
        pytest.importorskip("warp")
    many = randomized(sledge(impl), ALL_LEAVES, seed=1, first_env=0, num_envs=NUM_ENVS)
    batched = wrappers.vectorise(many)
    state = on_device(batched.reset(many.model, env_keys(jax.random.key(0), 0, NUM_ENVS)))
    step = jax.jit(batched.step)
    for _ in range(STEPS):
        state = step(many.model, state, np.tile(np.float32(STARTS["ctrl"]), (NUM_ENVS, 1)))
    leaves = drawn(sledge(), seed=1)
    effects = dict.fromkeys(RANDOMIZED_LEAVES, 0.0)
    for index in range(NUM_ENVS):
        expected = motion_in_c(model_of_env(many, leaves, index))
        np.testing.assert_allclose(state.physics.qvel[index], expected, atol=2e-4)
        for leaf in effects:
            without = {name: v for name, v in leaves.items() if name != f".{leaf}"}
            other = motion_in_c(model_of_env(many, without, index))
            effects[leaf] = max(effects[leaf], np.abs(other - expected).max())
    # Each leaf matters here, so none can have been forgotten.
    assert min(effects.values()) > 1e-3, effects


def motion_in_c(mj_model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(mj_model)
    data.qvel, data.ctrl = STARTS["qvel"], STARTS["ctrl"]
    for _ in range(STEPS):
        mujoco.mj_step(mj_model, data)
    return np.array(data.qvel)


def test_every_episode_may_have_a_model_of_its_own(env: Env, monkeypatch: pytest.MonkeyPatch):
    def step(model: Any, state: EnvState, action: jax.Array) -> EnvState:
        return state._replace(
            obs=model.dof_damping, truncated=jnp.ones((), bool), steps=state.steps + 1
        )

    ranges = {"dof_damping": ALL_LEAVES["dof_damping"]}
    pool = randomized(env, ranges, seed=3, first_env=0, num_envs=8).model
    drawn = randomized_by_episode(env._replace(step=step), ranges, seed=3, num_models=8)
    assert drawn.model_axes is None
    batch = training_env(drawn)
    state, moved = batch.init(drawn.model, env_keys(jax.random.key(1), 0, 16)), jax.jit(batch.step)
    seen = []
    for _ in range(3):
        numbers = np.asarray(state.env.task.number)
        state, out = moved(drawn.model, state, jnp.zeros((16, 2)))
        np.testing.assert_array_equal(out.next_obs, pool.dof_damping[numbers])
        seen.append(numbers)
    assert not np.array_equal(seen[0], seen[1])
    assert set(np.concatenate(seen)) == set(range(8))
    config = compose("env=ball_balance", "env.randomize=episode").env
    monkeypatch.setattr(randomize, "POOL", 3)
    envs = make_envs(config, "jax", seed=0, first_env=0, num_envs=2)
    assert envs.model.body_mass.shape[0] == 3


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"body_mas": (0.5, 2)}, r"env.randomization.body_mas: .*: did you mean body_mass\?"),
        ({"body_mass": (2, 1)}, r"body_mass.range=\[2.0, 1.0\]: expected \[lowest, highest\]"),
        ({"body_mass": ()}, r"body_mass.range=\[\]: expected \[lowest, highest\]"),
        ({"body_mass": (0, 1)}, r"body_mass.range\[0\]=0.0: must be greater than 0"),
        ({"pair_friction": (0, 1)}, r"pair_friction.range\[0\]=0.0: must be greater than 0"),
        ({"dof_damping": (-1, 1)}, r"dof_damping.range\[0\]=-1.0: must be at least 0"),
        ({"body_mass": (float("nan"), 1)}, "expected a list of numbers|expected a finite number"),
    ],
)
def test_ranges_that_are_refused_before_anything_starts(ranges: dict[str, Any], message: str):
    data = {leaf: {"operation": "scale", "range": list(r)} for leaf, r in ranges.items()}
    with pytest.raises(ConfigError, match=message) as error:
        from_dict(EnvConfig, {"name": "ant", "episode_length": 9, "randomization": data}, "env.")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("leaf", "operation", "low", "names", "message"),
    [
        ("body_mass", "scale", 1.0, ("torso",), "names=torso: sledge has no such name; allowed"),
        ("body_mass", "scale", 1.0, ("frame",), "nothing but zeros there"),
        ("body_mass", "set", 1.0, ("arm", "frame"), "names a body of sledge without mass"),
        ("body_mass", "add", -0.5, None, "values as low as 0.5, which would become 0"),
        ("dof_damping", "add", -1.0, None, "values as low as 0, which would become -1"),
        ("jnt_stiffness", "scale", 2.0, ("along",), "nothing but zeros there"),
        ("dof_frictionloss", "add", 0.0, ("along",), "without friction free of it"),
    ],
)
def test_what_the_model_cannot_have_is_refused(
    env: Env, leaf: str, operation: Any, low: float, names: tuple[str, ...] | None, message: str
):
    ranges = {leaf: LeafRange(operation=operation, range=(low, low + 1), names=names)}
    with pytest.raises(ConfigError, match=message):
        randomized(env, ranges, seed=0, first_env=0, num_envs=2)


def test_on_needs_something_to_draw_and_a_model_to_draw_it_in(env: Env):
    with pytest.raises(ConfigError, match=r"^env\.randomize=on: env\.randomization names nothing"):
        EnvConfig(name="ant", episode_length=9, randomize="on")
    foreign = env._replace(mj_model=None, model=())
    with pytest.raises(ConfigError, match=r"env\.randomize=on: sledge has no model of MJX"):
        randomized(foreign, ALL_LEAVES, seed=0, first_env=0, num_envs=2)


@pytest.mark.parametrize(("written", "is_on"), [("on", True), ("true", True), ("false", False)])
def test_environments_are_randomised_where_the_configuration_says_so(written: str, is_on: bool):
    config = compose("env=ball_balance", f"env.randomize={written}").env
    env = make_envs(config, "jax", seed=0, first_env=0, num_envs=2)
    assert (env.model_axes is not None) == is_on

import importlib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from gmijax.errors import ConfigError
from gmijax.sim import impl as implementations
from gmijax.sim import physics
from gmijax.sim.impl import WarpSizes
from gmijax.sim.physics import PhysicsState, choose_impl, from_mj_model
from gmijax.sim.registry import TASKS

PENDULUM_OVER_FLOOR = """
<mujoco>
  <option timestep="0.01" iterations="2" ls_iterations="4"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>
    <body pos="0 0 0.5">
      <joint name="hinge" axis="0 1 0" range="-3 3" limited="true"/>
      <geom name="rod" type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" contype="0"
            conaffinity="0"/>
      <site name="tip" pos="0.5 0 0"/>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="rod"/></contact>
  <actuator><motor joint="hinge" gear="2"/></actuator>
  <sensor><force site="tip"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize(
    ("impl", "platform", "task", "chosen", "why"),
    [
        ("auto", "cpu", "ant", "jax", "slow on cpu"),
        ("auto", "gpu", "ant", "warp", "the faster one for ant"),
        ("auto", "cuda", "theirs", "jax", "physics.impl=warp"),
        ("auto", "cuda", "playground/CheetahRun", "warp", "Playground itself"),
        ("auto", "cpu", "playground/CheetahRun", "jax", "slow on cpu"),
        ("auto", "gpu", None, "jax", "physics.impl=warp"),
        ("jax", "gpu", "ant", "jax", "set on the command line or by the run"),
        ("warp", "cpu", None, "warp", "set on the command line or by the run"),
    ],
)
def test_choice_of_implementation(
    impl: str, platform: str, task: str | None, chosen: str, why: str
):
    assert set(implementations.ON_GPU) == set(TASKS)
    choice, reason = choose_impl(impl, platform, task, warp_installed=True)
    assert choice == chosen
    assert why in reason
    if chosen == "warp" and impl == "auto":
        without = choose_impl(impl, platform, task, warp_installed=False)
        assert without[0] == "jax"
        assert without[1].startswith("warning: warp, ")
        assert why in without[1]


@pytest.mark.parametrize(
    ("impl", "message"),
    [
        ("warp", r"physics\.impl=warp: needs the package warp-lang"),
        ("cuda", r"physics\.impl=cuda: expected one of auto, jax, warp"),
    ],
)
def test_an_implementation_that_cannot_be_had(impl: str, message: str):
    with pytest.raises(ConfigError, match=message):
        choose_impl(impl, "gpu", warp_installed=False)


def test_the_small_state_forgets_nothing_and_substeps_are_steps_in_a_row():
    # The same compiled step, once fed with the whole data of the step before and once with data
    # rebuilt from the carried state: equal to the last bit, through contact and joint limit.
    model = mujoco.MjModel.from_xml_string(PENDULUM_OVER_FLOOR)
    sim = from_mj_model(model, impl="jax", substeps=3)
    step = jax.jit(lambda data: mjx.step(sim.model, data))
    at_once = jax.jit(sim.step)
    assert sim.control_dt_s == pytest.approx(0.03)
    blank = mjx.make_data(sim.model)
    whole = small = blank
    for ctrl in np.random.default_rng(0).uniform(-1, 1, (30, 1)).astype(np.float32):
        start = PhysicsState(whole.qpos, whole.qvel, whole.qacc_warmstart)
        for _ in range(sim.substeps):
            whole = step(whole.replace(ctrl=jnp.array(ctrl)))
            carried = PhysicsState(small.qpos, small.qvel, small.qacc_warmstart)
            kept = {name: value for name, value in carried._asdict().items() if value is not None}
            small = step(blank.replace(ctrl=jnp.array(ctrl), **kept))
            for name in ("qpos", "qvel", "qacc_warmstart", "sensordata"):
                np.testing.assert_array_equal(getattr(whole, name), getattr(small, name))
        moved, sensors = at_once(sim.model, start, jnp.array(ctrl))
        np.testing.assert_allclose(moved.qpos, whole.qpos, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(sensors, whole.sensordata, rtol=1e-3, atol=1e-3)


ARM_AND_FREE_BOX = """
<mujoco>
  <worldbody>
    <body pos="0.1 0.2 0.5" quat="1 1 0 0">
      <joint axis="0 1 0" pos="0 0 0.1" ref="0.3"/>
      <geom size="0.1"/>
      <body pos="0 0.3 0" euler="20 30 40">
        <joint type="slide" axis="1 0 1"/>
        <geom size="0.1"/>
        <body pos="0.2 0 0"><joint type="ball"/><geom size="0.1"/></body>
      </body>
    </body>
    <body pos="1 0 0.5"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_map_over_environments_goes_through_the_physics_steps_once():
    passes = []

    @jax.custom_batching.custom_vmap
    def reading(qpos: jax.Array) -> jax.Array:
        return qpos

    @reading.def_vmap
    def _(size: int, is_batched: list[bool], qpos: jax.Array) -> tuple[jax.Array, bool]:
        del size
        passes.append(1)
        return qpos, is_batched[0]

    mj_model = mujoco.MjModel.from_xml_string(PENDULUM_OVER_FLOOR)
    sim = from_mj_model(mj_model, impl="jax", substeps=2)

    def step(state: PhysicsState) -> jax.Array:
        return sim.step(sim.model, state, jnp.zeros(1), lambda data: reading(data.qpos))[1]

    jax.eval_shape(jax.vmap(step), PhysicsState(*jnp.zeros((3, 3, 1))))
    assert len(passes) == 1


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_poses_are_those_of_mujoco_in_c(impl: str):
    if impl == "warp":
        pytest.importorskip("warp")
    mj_model = mujoco.MjModel.from_xml_string(ARM_AND_FREE_BOX)
    sim = from_mj_model(mj_model, impl=impl, substeps=1, max_envs=1)
    poses = jax.jit(sim.poses)
    data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    for _ in range(5):
        # Quaternions of any length: C normalises them too.
        data.qpos = rng.uniform(-1, 1, mj_model.nq)
        mujoco.mj_kinematics(mj_model, data)
        xpos, xquat = poses(jnp.array(data.qpos, jnp.float32))
        np.testing.assert_allclose(xpos, data.xpos, atol=1e-5)
        np.testing.assert_allclose(xquat, data.xquat, atol=1e-5)


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_a_model_that_an_implementation_refuses_is_an_error_of_one_line(impl: str):
    if impl == "warp":
        pytest.importorskip("warp")
    # 70 degrees of freedom with dense matrices: too many for MJX-Warp. MJX-JAX takes the second
    # model, and then cannot make its data.
    balls = "<body><freejoint/><geom size='0.1' condim='1'/></body>" * 12
    option = "jacobian='dense'" if impl == "warp" else "cone='elliptic'"
    text = f"<mujoco model='balls'><option {option}/><worldbody>{balls}</worldbody></mujoco>"
    message = rf"^physics\.impl={impl}: .+ cannot simulate the model balls: .+"
    with pytest.raises(ConfigError, match=message) as error:
        from_mj_model(mujoco.MjModel.from_xml_string(text), impl=impl, substeps=1, max_envs=1)
    assert "\n" not in str(error.value)


DROPPED_BALLS = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body pos="0 0 0.09"><freejoint/><geom size="0.1"/></body>
    <body pos="1 0 0.09"><freejoint/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("sizes", "overflow"),
    [
        (WarpSizes(2, 8), [False, False]),
        (WarpSizes(1, 8), [True, False]),
        (WarpSizes(2, 7), [False, True]),
        (None, [False, False]),
    ],
)
def test_a_buffer_of_warp_that_is_too_small_is_noticed(
    sizes: WarpSizes | None, overflow: list[bool]
):
    pytest.importorskip("warp")
    sim = from_mj_model(
        mujoco.MjModel.from_xml_string(DROPPED_BALLS),
        impl="warp",
        substeps=2,
        max_envs=3,
        warp_sizes=sizes,
    )
    qpos = jnp.tile(jnp.array(sim.mj_model.qpos0, jnp.float32), (3, 1))
    start = jax.vmap(sim.start)(qpos, jnp.zeros((3, sim.mj_model.nv)))
    assert start.overflow is not None
    assert not start.overflow.any()
    step = jax.jit(jax.vmap(sim.step, in_axes=(None, 0, None)))
    moved, _ = step(sim.model, start, jnp.zeros(0))
    assert moved.overflow is not None
    assert moved.overflow.tolist() == [overflow] * 3


def test_bits_of_overflow_are_those_of_warp():
    pytest.importorskip("warp")
    kinds = importlib.import_module("mujoco.mjx.third_party.mujoco_warp._src.types").OverflowType
    assert physics.CONSTRAINT_BITS == kinds.NEFC | kinds.NJMAX_NNZ
    assert physics.LIMIT_BITS == kinds.ITERATIONS | kinds.LS_ITERATIONS | kinds.HFIELD
    assert physics.ALL_BITS == kinds.ALL


def test_environments_of_several_jobs_move_as_those_of_one():
    pytest.importorskip("warp")
    mj_model = mujoco.MjModel.from_xml_string(PENDULUM_OVER_FLOOR)
    sim = from_mj_model(mj_model, impl="warp", substeps=2)
    rng = np.random.default_rng(0)
    qpos, qvel, ctrl = (jnp.array(rng.uniform(-1, 1, (2, 3, 1)), jnp.float32) for _ in range(3))
    start = jax.vmap(jax.vmap(sim.start))(qpos, qvel)
    step = jax.vmap(sim.step, in_axes=(None, 0, 0))
    together = jax.jit(jax.vmap(step, in_axes=(None, 0, 0)))(sim.model, start, ctrl)
    for job in range(2):
        alone = jax.jit(step)(sim.model, jax.tree.map(lambda x, j=job: x[j], start), ctrl[job])
        for own, all_of_them in zip(*map(jax.tree.leaves, (alone, together)), strict=True):
            np.testing.assert_allclose(own, all_of_them[job], atol=1e-5)

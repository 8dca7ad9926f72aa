"""What environments carry between steps beside positions, velocities and the warm start."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled_tasks import on_device

from gmijax.errors import ConfigError
from gmijax.sim import episode
from gmijax.sim.interface import EnvSpec
from gmijax.sim.physics import Physics, PhysicsState, from_mj_model
from gmijax.sim.stage import put
from gmijax.sim.wrappers import auto_reset, vectorise

ALL_OF_IT = """
<mujoco model="all">
  <option timestep="0.005" iterations="20" ls_iterations="20"/>
  <worldbody>
    <body name="limb"><joint name="elbow" axis="0 1 0" damping="0.1" range="-120 120"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1" contype="0"/></body>
    <body name="wheel" pos="0 1 0"><joint name="axle" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1" contype="0"/></body>
    <body name="hand" mocap="true" pos="0 2 0"/>
    <body name="held" pos="0 2 0"><freejoint/><geom size="0.05" mass="1" contype="0"/></body>
    <body name="rope" pos="0 3 0"><freejoint/><geom size="0.05" mass="1" contype="0"/></body>
    <body name="pushed" pos="0 4 0"><freejoint/><geom size="0.05" mass="1" contype="0"/></body>
  </worldbody>
  <equality>
    <weld body1="hand" body2="held"/>
    <connect name="hook" body1="rope" anchor="0 0 0.2"/>
  </equality>
  <actuator>
    <muscle name="biceps" joint="elbow" force="20" lengthrange="0.01 2"/>
    <general name="servo" joint="axle" dyntype="filter" dynprm="0.1" gainprm="5"/>
    <general name="winch" joint="axle" dyntype="integrator" actlimited="true" actrange="-1 1"/>
  </actuator>
  <sensor><clock/></sensor>
</mujoco>
"""

STEPS, SUBSTEPS = 40, 2


def driven(step: int, hand: np.ndarray) -> dict[str, np.ndarray]:
    """What a task sets in a control step: a path, a push, a turn of a joint, a hook let go."""
    push = np.zeros((7, 6))
    push[6, :3] = (0.0, 0.0, 30.0) if 5 <= step < 15 else 0.0
    turn = np.zeros(20)
    turn[1] = 0.5 if step >= 10 else 0.0
    return {
        "mocap_pos": hand + np.array([[0.002 * step, 0.0, 0.001 * step]]),
        "eq_active": np.array([True, step < 20]),
        "xfrc_applied": push,
        "qfrc_applied": turn,
    }


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_what_is_carried_moves_an_environment_as_mujoco_in_c(impl: str):
    if impl == "warp":
        pytest.importorskip("warp")
    mj_model = mujoco.MjModel.from_xml_string(ALL_OF_IT)
    sim = from_mj_model(mj_model, impl=impl, substeps=SUBSTEPS, max_envs=2)
    data, rng = mujoco.MjData(mj_model), np.random.default_rng(0)
    hand = data.mocap_pos.copy()
    qpos, qvel = (jnp.tile(jnp.asarray(x, jnp.float32), (2, 1)) for x in (data.qpos, data.qvel))
    first = {name: jnp.asarray(value) for name, value in driven(0, hand).items()}
    state = on_device(jax.vmap(lambda q, v: sim.start(q, v, **first))(qpos, qvel))
    assert state.act is not None
    assert state.act.shape == (2, 3)
    step = jax.jit(jax.vmap(sim.step, in_axes=(None, 0, 0)))
    for count in range(STEPS):
        ctrl = rng.uniform(0, 1, mj_model.nu)
        now = driven(count, hand)
        for name, value in now.items():
            getattr(data, name)[:] = value
        data.ctrl[:] = ctrl
        for _ in range(SUBSTEPS):
            clock_s = data.time
            mujoco.mj_step(mj_model, data)
        set_now = {
            name: np.tile(value, (2, *[1] * value.ndim)).astype(getattr(state, name).dtype)
            for name, value in now.items()
        }
        state, sensed = step(
            sim.model,
            state._replace(**on_device(set_now)),
            np.tile(ctrl.astype(np.float32), (2, 1)),
        )
        np.testing.assert_allclose(state.act[1], data.act, atol=1e-5)
        np.testing.assert_allclose(state.time[1], data.time, rtol=1e-5)
        np.testing.assert_allclose(sensed[1], [clock_s], rtol=1e-5)
        np.testing.assert_allclose(state.mocap_pos[1], data.mocap_pos, atol=1e-6)
        np.testing.assert_allclose(state.qpos[1], data.qpos, atol=2e-4)
    held, rope, pushed = (data.body(name).xpos for name in ("held", "rope", "pushed"))
    assert held[0] > 0.05
    assert rope[2] < -0.01
    assert pushed[2] > -0.5
    if state.overflow is not None:
        assert not state.overflow.any()


ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-9 9"/><geom size="0.1"/>
</body><body mocap="true"/></worldbody><actuator>{}</actuator></mujoco>"""


def sim_with(actuator: str) -> Physics:
    return from_mj_model(
        mujoco.MjModel.from_xml_string(ARM.format(actuator)), impl="jax", substeps=1
    )


def test_a_model_without_memory_carries_nothing_more():
    sim = sim_with('<motor joint="a"/>')
    start = sim.start(jnp.zeros(1), jnp.zeros(1))
    assert start == PhysicsState(start.qpos, start.qvel, start.qacc_warmstart)
    assert len(jax.tree.leaves(start)) == 3
    moved, _ = jax.eval_shape(sim.step, sim.model, start, jnp.zeros(1))
    assert jax.tree.structure(moved) == jax.tree.structure(start)


def test_a_start_knows_names_and_shapes_of_what_is_carried():
    sim, at = sim_with('<motor joint="a"/>'), (jnp.zeros(1), jnp.zeros(1))
    with pytest.raises(ConfigError, match=r"no mocap can be carried; allowed: act, time, history"):
        sim.start(*at, mocap=jnp.zeros(3))
    with pytest.raises(ConfigError, match=r"mocap_pos has shape \(3,\), not \(1, 3\)"):
        sim.start(*at, mocap_pos=jnp.zeros(3))
    with pytest.raises(ConfigError, match=r"eq_active has shape \(1,\), not \(0,\)"):
        sim.start(*at, eq_active=jnp.ones(1))


def test_a_state_without_the_activations_of_its_model_is_refused():
    sim = sim_with('<general joint="a" dyntype="filter" dynprm="0.1"/>')
    forgetful = PhysicsState(*jnp.zeros((3, 1)))
    with pytest.raises(ConfigError, match="the state has no act, which sim"):
        jax.eval_shape(sim.step, sim.model, forgetful, jnp.zeros(1))


@pytest.mark.parametrize("given", [("mocap_pos",), ("mocap_quat",), ("mocap_pos", "mocap_quat")])
def test_a_picture_shows_where_mocap_bodies_have_moved(given: tuple[str, ...]):
    text = ARM.format("").replace("<body mocap", '<body pos="0 1 0" mocap')
    sim = from_mj_model(mujoco.MjModel.from_xml_string(text), impl="jax", substeps=1)
    at = jnp.full(1, 0.5), jnp.zeros(1)
    assert sim.shown(sim.start(*at)).tolist() == [0.5]
    moved = {"mocap_pos": [[1.0, 2.0, 3.0]], "mocap_quat": [[0.0, 1.0, 0.0, 0.0]]}
    start = sim.start(*at, **{name: jnp.array(moved[name]) for name in given})
    data = mujoco.MjData(sim.mj_model)
    still = {"mocap_pos": [[0.0, 1.0, 0.0]], "mocap_quat": [[1.0, 0.0, 0.0, 0.0]]}
    put(data, np.asarray(sim.shown(start)))
    assert data.qpos.tolist() == [0.5]
    for name in moved:
        assert getattr(data, name).tolist() == (moved if name in given else still)[name]


def test_an_automatic_reset_begins_with_what_a_start_carries():
    sim = sim_with('<general joint="a" dyntype="filter" dynprm="0.1"/>')
    spec, goal = EnvSpec("reach", 1, 1, 0.01, 10, ()), jnp.array([[0.0, 0.0, 1.0]])

    def reset(model, key):
        start = sim.start(jnp.zeros(1), jnp.zeros(1), mocap_pos=goal, act=jnp.full(1, 0.25))
        return episode.begin(spec, start, (), start.qpos, key)

    env = vectorise(sim.env(spec, reset, lambda model, state, action: state))
    state = env.reset(sim.model, jax.random.split(jax.random.key(0), 2))
    moved = state.physics._replace(act=jnp.ones((2, 1)), mocap_pos=jnp.ones((2, 1, 3)))
    ended = state._replace(physics=moved, terminated=jnp.array([True, False]))
    after = auto_reset(env, sim.model, ended).physics
    assert after.act.tolist() == [[0.25], [1.0]]
    assert after.mocap_pos.tolist() == [goal.tolist(), [[1.0, 1.0, 1.0]]]

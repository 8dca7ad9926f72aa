import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compile_options import CPU_OPTIONS
from mujoco import mjx

from gmijax.errors import ConfigError
from gmijax.sim.physics import PhysicsState, choose_impl, from_mj_model

# Halves the time to compile; other devices do not know the option.

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
    ("impl", "platform", "warp_installed", "chosen", "why"),
    [
        ("auto", "cpu", True, "jax", "slow on cpu"),
        ("auto", "gpu", False, "jax", "not installed"),
        ("auto", "gpu", True, "jax", "physics.impl=warp"),
        ("auto", "cuda", True, "jax", "physics.impl=warp"),
        ("jax", "gpu", True, "jax", "asked for"),
        ("warp", "cpu", True, "warp", "asked for"),
    ],
)
def test_choice_of_implementation(
    impl: str, platform: str, warp_installed: bool, chosen: str, why: str
):
    choice, reason = choose_impl(impl, platform, warp_installed=warp_installed)
    assert choice == chosen
    assert why in reason


def test_warp_without_warp_lang_says_what_to_install():
    with pytest.raises(ConfigError, match=r"physics\.impl=warp: needs the package warp-lang"):
        choose_impl("warp", "gpu", warp_installed=False)


def test_unknown_implementation():
    with pytest.raises(ConfigError, match=r"physics\.impl=cuda: allowed are auto, jax, warp"):
        choose_impl("cuda", "gpu")


def test_actuators_with_memory_are_refused():
    text = PENDULUM_OVER_FLOOR.replace(
        '<motor joint="hinge" gear="2"/>',
        '<general joint="hinge" dyntype="integrator"/>',
    )
    with pytest.raises(ConfigError, match="1 activations"):
        from_mj_model(mujoco.MjModel.from_xml_string(text), impl="jax", substeps=1)


def test_the_small_state_forgets_nothing_that_the_next_step_needs():
    # The same compiled step, once fed with the whole data of the step before and once with data
    # rebuilt from the carried state: equal to the last bit, through contact and joint limit.
    world = from_mj_model(
        mujoco.MjModel.from_xml_string(PENDULUM_OVER_FLOOR), impl="jax", substeps=1
    )
    step = jax.jit(lambda data: mjx.step(world.model, data), compiler_options=CPU_OPTIONS)
    whole = small = world.blank()
    for ctrl in np.random.default_rng(0).uniform(-1, 1, (100, 1)).astype(np.float32):
        whole = step(whole.replace(ctrl=jnp.array(ctrl)))
        carried = PhysicsState(small.qpos, small.qvel, small.qacc_warmstart)
        small = step(world.blank().replace(ctrl=jnp.array(ctrl), **carried._asdict()))
        for name in ("qpos", "qvel", "qacc_warmstart", "sensordata"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(small, name))


def test_substeps_are_steps_in_a_row():
    model = mujoco.MjModel.from_xml_string(PENDULUM_OVER_FLOOR)
    one, three = (from_mj_model(model, impl="jax", substeps=n) for n in (1, 3))
    ctrl = jnp.array([0.3])
    single = jax.jit(one.step, compiler_options=CPU_OPTIONS)
    start = state = one.start(jnp.zeros(1), jnp.zeros(1))
    for _ in range(2):
        state, _ = single(one.model, state, ctrl)
    state, sensors = single(one.model, state, ctrl)
    at_once, last_sensors = jax.jit(three.step, compiler_options=CPU_OPTIONS)(
        three.model, start, ctrl
    )
    np.testing.assert_allclose(at_once.qpos, state.qpos, rtol=1e-5)
    np.testing.assert_allclose(last_sensors, sensors, rtol=1e-4, atol=1e-5)
    assert three.control_dt_s == pytest.approx(0.03)

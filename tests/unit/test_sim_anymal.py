import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gmijax.sim import physics, simulators
from gmijax.sim.adapters.checks import check_env
from gmijax.sim.registry import make_env
from gmijax.sim.tasks import anymal
from gmijax.sim.tasks.settings import AnymalSettings

HIGH_KNEES = jnp.full((4, 3), 0.3)


@pytest.fixture(scope="module")
def model():
    return simulators.load("anymal", impl="jax", substeps=anymal.SUBSTEPS).mj_model


def state(
    position: tuple[float, float, float] = (0.0, 0.0, 0.5),
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    angle_deg: float = 0.0,
    velocity: tuple[float, ...] = (0.0,) * 6,
) -> physics.PhysicsState:
    """The base at `position`, turned by `angle_deg` about `axis`; all joints at 0, at rest."""
    half = np.deg2rad(angle_deg) / 2.0
    quat = np.append(np.cos(half), np.sin(half) * np.array(axis))
    qpos = np.concatenate([position, quat, np.zeros(12)])
    qvel = np.concatenate([velocity, np.zeros(12)])
    return physics.PhysicsState(
        jnp.array(qpos, jnp.float32), jnp.array(qvel, jnp.float32), jnp.zeros(18)
    )


def test_gravity_points_forwards_when_the_nose_is_down_wherever_the_robot_looks():
    nose_down = state(axis=(0.0, 1.0, 0.0), angle_deg=30.0)
    expected = [0.5, 0.0, -np.sqrt(0.75)]
    np.testing.assert_allclose(anymal.gravity_direction(nose_down), expected, atol=1e-6)
    # Looking back: a turn by 180 degrees about z after the one about y.
    w, x, y, z = nose_down.qpos[3:7]
    looking_back = nose_down._replace(qpos=nose_down.qpos.at[3:7].set(jnp.stack([-z, -y, x, w])))
    np.testing.assert_allclose(anymal.gravity_direction(looking_back), expected, atol=1e-6)


def test_errors_are_measured_in_the_frame_of_the_base():
    # A quarter turn to the left: the world's y is forwards, and -x is to the left.
    moving = state(angle_deg=90.0, velocity=(-0.5, 2.0, 0.3, 0.0, 0.0, 0.75))
    velocity, yaw_rate = anymal.errors(moving, jnp.array([2.0, 0.5, 0.75]))
    assert float(velocity) == pytest.approx(0.0, abs=1e-6)
    assert float(yaw_rate) == pytest.approx(0.0, abs=1e-6)
    velocity, yaw_rate = anymal.errors(moving, jnp.array([-1.0, 4.5, -0.25]))
    assert float(velocity) == pytest.approx(5.0)
    assert float(yaw_rate) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("velocity", "torque", "total"), [(0.02, -0.005, 0.015), (0.01, -0.05, 0)]
)
def test_a_reward_below_zero_is_lifted_to_zero_by_a_term(velocity, torque, total):
    terms = {"velocity": jnp.array(velocity), "torque": jnp.array(torque)}
    reward, lifted = anymal.not_below_zero((sum(terms.values(), jnp.zeros(())), terms))
    assert float(reward) == pytest.approx(total)
    assert float(sum(lifted.values())) == pytest.approx(total, abs=1e-9)
    assert lifted.keys() - terms.keys() == {"floor"}


@pytest.mark.parametrize(
    ("pose", "fallen"),
    [
        (state(), False),
        (state(position=(0.0, 0.0, 0.08)), True),
        (state(position=(0.0, 0.0, 0.4), axis=(0.0, 1.0, 0.0), angle_deg=25.0), False),
        (state(position=(0.0, 0.0, 0.4), axis=(0.0, 1.0, 0.0), angle_deg=45.0), True),
        (state(position=(0.0, 0.0, 2.0), axis=(1.0, 0.0, 0.0), angle_deg=89.0), False),
        (state(position=(0.0, 0.0, 2.0), axis=(1.0, 0.0, 0.0), angle_deg=91.0), True),
    ],
)
def test_a_robot_whose_base_is_down_or_upside_down_has_fallen(pose, fallen):
    assert bool(anymal.has_fallen(pose, HIGH_KNEES)) is fallen


def test_a_robot_with_one_knee_on_the_floor_has_fallen():
    assert not anymal.has_fallen(state(), HIGH_KNEES.at[2, 2].set(0.07))
    assert anymal.has_fallen(state(), HIGH_KNEES.at[2, 2].set(0.06))


def test_starts_and_commands_fill_their_ranges(model):
    ids = anymal.look_up(model)
    keys = jax.random.split(jax.random.key(0), 256)
    qpos, qvel = jax.vmap(lambda key: anymal.draw_start(ids, model, key, AnymalSettings()))(keys)
    factors = np.asarray(qpos[:, ids.joints.qpos]) / ids.standing
    assert 0.5 <= factors.min() < 0.52
    assert 1.48 < factors.max() <= 1.5
    np.testing.assert_array_equal(
        qpos[:, :7], np.tile([0, 0, 0.62, 1, 0, 0, 0], (256, 1)).astype("f4")
    )
    assert float(jnp.abs(qvel).max()) <= 0.1
    commands = np.asarray(jax.vmap(lambda key: anymal.draw_command(key, AnymalSettings()))(keys))
    assert (np.abs(commands) <= [2.0, 1.0, 1.0]).all()
    assert (commands.max(axis=0) > [1.8, 0.9, 0.9]).all()
    assert (commands.min(axis=0) < [-1.8, -0.9, -0.9]).all()


def test_observation_has_the_documented_places_and_limits(model):
    moving = state(velocity=(9.0, 0.5, 0.0, 0.0, 0.0, 2.0))
    obs = anymal.observe(
        anymal.look_up(model), moving, jnp.array([1.0, -0.5, 1.0]), jnp.full(12, 0.25)
    )
    assert obs.shape == (anymal.OBS_SIZE,)
    np.testing.assert_allclose(obs[:6], [5.0, 1.0, 0.0, 0.0, 0.0, 0.5])
    np.testing.assert_allclose(obs[6:12], [0.0, 0.0, -1.0, 2.0, -1.0, 0.25])
    np.testing.assert_allclose(obs[12:15], [-0.03, -0.4, 0.8])
    np.testing.assert_allclose(obs[24:], [0.0] * 12 + [0.25] * 12)


def test_servos_hold_the_standing_pose(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.qpos[2] == pytest.approx(0.48, abs=0.02)
    assert np.abs(data.qvel).max() < 0.1
    knees = jnp.array(data.xpos[anymal.look_up(model).shanks])
    standing = physics.PhysicsState(*map(jnp.array, (data.qpos, data.qvel, data.qvel)))
    assert not anymal.has_fallen(standing, knees)


def glide(sim, model, state, ctrl, read):
    """In place of physics: the base gets faster by the control of the first joint."""
    faster = state._replace(qvel=state.qvel.at[0].add(ctrl[0]))
    return faster, (jnp.zeros(anymal.ACTION_SIZE), HIGH_KNEES)


def test_commands_grow_with_the_episodes_that_succeed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(physics.Physics, "step", glide)
    settings = {"curriculum_start": 0.25, "curriculum_growth": 0.5}
    env = make_env("anymal", impl="jax", curriculum=True, settings=settings, episode_length=5)
    check_env(env, "anymal")
    assert env.spec.metrics == (*anymal.METRICS, anymal.SHARE)
    assert env.next_episode is not None
    keys = jax.random.split(jax.random.key(0), 64)
    first = jax.jit(jax.vmap(env.reset, in_axes=(None, 0)))(env.model, keys)
    assert (jnp.abs(first.task.command) <= 0.25 * jnp.array([2.0, 1.0, 1.0])).all()
    assert float(jnp.abs(first.task.command[:, 0]).max()) > 0.45
    again, shares = jax.jit(jax.vmap(env.next_episode, in_axes=(None, 0))), []
    near, far = ({name: jnp.full(64, x) for name in env.spec.metrics} for x in (0.2, 0.3))
    true, false = jnp.ones(64, bool), jnp.zeros(64, bool)
    state = first
    for metrics, in_time in ((near, false), (far, true), (near, true), (near, true)):
        state = again(env.model, state._replace(metrics=metrics, truncated=in_time))
        shares.append(float(state.task.share[0]))
    assert shares == [0.25, 0.25, 0.75, 1.0]
    assert float(jnp.abs(state.task.command[:, 0]).max()) > 1.8
    assert not np.array_equal(state.task.command, first.task.command)


def test_metrics_are_means_over_the_steps_of_the_episode(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(physics.Physics, "step", glide)
    env = make_env("anymal", impl="jax")
    now, step = jax.jit(env.reset)(env.model, jax.random.key(0)), jax.jit(env.step)
    command = now.task.command
    history = []
    for i in range(3):
        now = step(env.model, now, jnp.full(12, 0.1 * i))
        history.append([float(error) for error in anymal.errors(now.physics, command)])
    assert history[0] != history[1]
    np.testing.assert_array_equal(now.task.command, command)
    means = [float(now.metrics[name]) for name in anymal.METRICS]
    np.testing.assert_allclose(means, np.mean(history, axis=0), rtol=1e-4)

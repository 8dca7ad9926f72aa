"""What is recorded of policies in JAX for the walking test, in an environment without physics."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import gmijax
from gmijax.errors import ConfigError
from gmijax.learning import memory
from gmijax.learning.learner import init_learner, make_learner
from gmijax.learning.walking import WalkingTest, act_of
from gmijax.player import walking
from gmijax.player.joystick import ROBOTS, Readings
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.workers import playback

XML = """
<mujoco>
  <worldbody>
    <body name="trunk">
      <freejoint/>
      <site name="imu"/>
      <geom size="0.1"/>
      <body>
        <joint name="a" axis="0 1 0" actuatorfrcrange="-3 3"/>
        <geom size="0.1"/>
        <body>
          <joint name="b" axis="0 1 0"/>
          <geom size="0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="b" forcerange="-5 5"/>
    <position joint="a" forcerange="-4 4"/>
  </actuator>
  <sensor>
    <gyro site="imu" name="gyro"/>
    <velocimeter site="imu" name="local_linvel"/>
  </sensor>
</mujoco>
"""


class Data(NamedTuple):
    qpos: Any
    qvel: Any
    sensordata: Any
    qfrc_actuator: Any
    xfrc_applied: Any


class Physics(NamedTuple):
    data: Data


class Task(NamedTuple):
    info: dict[str, Any]


SPEC = EnvSpec("walker", 1, 2, 0.02, 1000, ("reward",))


def state_of(number, key, data: Data, info, terminated) -> EnvState:
    zero = jnp.zeros(())
    obs = jnp.asarray(number, jnp.float32)[None]
    ended = jnp.asarray(terminated), jnp.zeros((), bool)
    return EnvState(
        Physics(data), Task(info), obs, zero, {"reward": zero}, {}, *ended, number, key
    )


def reset(model, key) -> EnvState:
    del model
    qpos = jnp.zeros(9).at[2].set(0.3).at[3].set(1.0)
    data = Data(qpos, jnp.zeros(8), jnp.zeros(6), jnp.zeros(8), jnp.zeros((4, 6)))
    info = {"command": jnp.zeros(3), "push": jnp.zeros(2)}
    return state_of(jnp.zeros((), jnp.int32), key, data, info, terminated=False)


def step(model, state: EnvState, action) -> EnvState:
    """In step k: forces of the action, and disturbances at fixed steps."""
    del model
    number = state.steps + 1
    before = state.physics.data
    data = Data(
        # Bad numbers, in the 61st step alone if the environment goes on from them.
        qpos=before.qpos.at[8].set(jnp.where(number == 61, jnp.nan, 0.0)),
        qvel=before.qvel,
        sensordata=jnp.arange(6, dtype=jnp.float32),
        qfrc_actuator=jnp.zeros(8).at[6:].set(action),
        xfrc_applied=jnp.zeros((4, 6)).at[1, 0].set(jnp.where(number == 10, 5.0, 0.0)),
    )
    info = {
        "command": jnp.full(3, 1.0 * (number >= 20)),
        "push": jnp.array([0.0, 1.0]) * (number == 30),
    }
    return state_of(number, state.key, data, info, number == 55)


@pytest.fixture
def recorded(monkeypatch):
    """What the test measures of 3 environments in 1.3 s."""
    model = mujoco.MjModel.from_xml_string(XML)
    env = Env(SPEC, (), reset, step, model, lambda state: state.physics.data.qpos)
    found = []
    monkeypatch.setattr(
        "gmijax.learning.walking.measure", lambda *given: found.append(given) or given
    )

    def act(weights, obs):
        return jnp.broadcast_to(weights, (len(obs), 2))

    test = WalkingTest(env, ROBOTS["go1"], act, num_envs=3, seed=0, length_s=1.3)
    weights = jnp.array([2.0, -1.0])
    with pytest.MonkeyPatch.context() as little:
        little.setattr(memory, "memory_bytes", lambda: 64.0)
        with pytest.raises(ConfigError, match=r"^walking_envs: 3 environments in one process"):
            test.compile(weights)
    test.compile(weights)
    chunks = []
    test.run(weights, chunks.append)
    assert chunks == [1, 2]
    ((steps, robot, _, control_dt_s),) = found
    assert (robot.name, control_dt_s) == ("go1", 0.02)
    return steps


def test_a_recording_has_every_step_of_the_time_and_no_more(recorded):
    assert recorded.qpos.shape == (65, 3, 9)
    assert recorded.command.shape == recorded.velocity.shape == (65, 3, 3)
    assert recorded.load.shape == (65, 3, 2)


def test_the_command_is_that_of_before_the_step_and_pushes_and_new_ones_are_noted(recorded):
    assert (recorded.command[:20] == 0).all()
    assert (recorded.command[20:60] == 1).all()
    steps = np.flatnonzero(recorded.disturbed[:60, 0]) + 1
    assert list(steps) == [10, 20, 30]
    assert np.flatnonzero(recorded.done[:60, 0]) == [54]


def test_numbers_are_read_where_the_model_has_them(recorded):
    # Velocities are behind the gyro; joint b is driven first; a has a limit of 3 of its own.
    assert recorded.velocity[0, 0] == pytest.approx([3.0, 4.0, 2.0])
    assert recorded.load[0, 0] == pytest.approx([1 / 5, 2 / 3])


def test_an_environment_with_bad_numbers_is_recorded_and_goes_on_from_where_it_was(recorded):
    assert np.isnan(recorded.qpos[60:, :, 8]).all()  # In the 61st step, which it repeats.
    assert np.isfinite(recorded.qpos[:60]).all()


def test_a_limit_of_1000_n_m_is_none():
    text = XML.replace('forcerange="-5 5"', 'forcerange="-1000 1000"')
    readings = Readings(mujoco.MjModel.from_xml_string(text), ROBOTS["go1"])
    assert readings.torque_limit_n_m == pytest.approx([np.inf, 3.0])
    data = SimpleNamespace(qfrc_actuator=np.ones(8))
    assert readings.load(data) == pytest.approx([0.0, 1 / 3])


def test_a_robot_without_limits_has_no_load():
    loads = np.zeros((10, 12), np.float32)
    assert walking._loads(loads) == {"load_rms": None, "load_p99": None}


def test_starts_are_the_same_for_a_seed_and_others_for_another():
    model = mujoco.MjModel.from_xml_string(XML)
    began = []

    def noted(model, key):
        jax.debug.callback(
            lambda data: began.append(tuple(np.asarray(data).tolist())), jax.random.key_data(key)
        )
        return reset(model, key)

    def keys(seed):
        began.clear()
        env = Env(SPEC, (), noted, step, model, lambda state: state.physics.data.qpos)
        test = WalkingTest(env, ROBOTS["go1"], act, num_envs=2, seed=seed, length_s=1.0)
        weights = jnp.zeros(2)
        test.compile(weights)
        test.run(weights)
        jax.effects_barrier()
        return set(began)

    def act(weights, obs):
        return jnp.broadcast_to(weights, (len(obs), 2))

    # Of the environments' starts themselves: none is that of another, or of another seed.
    assert keys(0) == keys(0)
    assert len(keys(0) | keys(1)) == 4


def test_playing_tests_the_policy_of_the_checkpoint(monkeypatch):
    model = mujoco.MjModel.from_xml_string(XML)
    env = Env(SPEC, (), reset, step, model, lambda state: state.physics.data.qpos)
    monkeypatch.setattr("gmijax.learning.walking.walking_env", lambda *_: env)
    algo = gmijax.compose("env=go1", "algo.policy_hidden_layer_sizes=[4]").algo
    algo = dataclasses.replace(algo, value_obs_key="auto")
    learner = make_learner(SPEC, algo)
    state = init_learner(learner, SPEC.obs_size, jax.random.key(0))
    beats = []
    link: Any = SimpleNamespace(beat=lambda *beat: beats.append(beat))

    task = gmijax.compose("env=go1", "env.settings.noise=0.5").env

    def walk(task=task, **changes):
        config: Any = SimpleNamespace(seed=0, **changes)
        return playback._walk(config, task, ROBOTS["go1"], "jax", link, learner, state)

    found = walk(walking_envs=2) or {}
    assert json.loads(json.dumps(found)) == found
    assert (found["num_envs"], found["length_s"], found["walks"]) == (2, 20.0, None)
    assert found["settings"] == {"noise": 0.5}
    assert found["falls"] == {"not_finite": 0, "low": 0, "tilted": 0, "done": 2}
    # Observations count the steps, torques are the actions; a fall is seen in the 55th step.
    actions = act_of(learner)(state, jnp.arange(54, dtype=jnp.float32)[:, None])
    loads = np.asarray(actions) / [3, 5]
    assert found["load_rms"] == pytest.approx(np.sqrt((loads**2).mean()), rel=1e-4)
    assert np.std(loads) > 1e-3
    assert beats[:2] == [("compiling", 0), ("running", 1)]
    assert beats[-1] == ("running", 20)
    assert walk(walking_envs=0) is None
    assert walk(walking_envs=2, task=dataclasses.replace(task, action_repeat=2)) is None
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    monkeypatch.setattr(playback, "NUM_ENVS", 3)
    assert (walk(walking_envs=None) or {})["num_envs"] == 3
    monkeypatch.setattr("jax.default_backend", lambda: "cpu")
    assert walk(walking_envs=None) is None

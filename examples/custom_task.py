"""A task of your own: a pole that a cart swings up: `python examples/custom_task.py`."""

import sys
from collections import namedtuple

import jax
import jax.numpy as jnp
import mujoco

import gmijax
from gmijax.sim import episode, physics
from gmijax.sim.interface import Env, EnvSpec
from gmijax.sim.rewards import RewardTerm, term_names, total_reward, with_weights

MJCF = """<mujoco><option timestep="0.01" iterations="2"><flag eulerdamp="disable"/></option>
<worldbody><light pos="0 -2 3"/><camera name="track" pos="0 -4 1" xyaxes="1 0 0 0 0.2 1"/>
  <body><joint name="slide" type="slide" axis="1 0 0" range="-2 2" limited="true" damping="0.1"/>
    <geom type="box" size="0.15 0.1 0.08" mass="1" contype="0" conaffinity="0"/>
    <body><joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.8" size="0.03" mass="0.1" contype="0"/>
</body></body></worldbody><actuator><motor joint="slide" gear="20"/></actuator></mujoco>"""

View = namedtuple("View", "qpos action")  # What the terms of the reward may read.
TERMS = {
    "upright": RewardTerm[View](lambda v: 0.5 + 0.5 * jnp.cos(v.qpos[1]), 1.0),
    "centre": RewardTerm[View](lambda v: v.qpos[0] ** 2, -0.1),
    "effort": RewardTerm[View](lambda v: v.action[0] ** 2, -0.01),
}


def make(*, impl="auto", max_envs=None, rewards=None) -> Env:
    """The task: observation [5], action [1], 50 steps a second, 500 of them an episode."""
    mj_model = mujoco.MjModel.from_xml_string(MJCF)
    sim = physics.from_mj_model(mj_model, impl=impl, substeps=2, max_envs=max_envs)
    terms = with_weights(TERMS, rewards)  # As `env.rewards.effort=-0.1` says.
    spec = EnvSpec("swing_up", 5, 1, sim.control_dt_s, 500, term_names(terms))

    def observe(now):
        return jnp.array([now.qpos[0], jnp.cos(now.qpos[1]), jnp.sin(now.qpos[1]), *now.qvel])

    def reset(model, key):
        key, draw = jax.random.split(key)
        hanging = jnp.array([0.0, jnp.pi]) + 0.1 * jax.random.normal(draw, (2,))
        start = sim.start(hanging, jnp.zeros(2))
        return episode.begin(spec, start, (), observe(start), key)

    def step(model, state, action):
        action = jnp.clip(action, -1.0, 1.0)
        now, _ = sim.step(model, state.physics, action)
        reward = total_reward(terms, View(now.qpos, action))
        return episode.advance(state, now, (), observe(now), reward, jnp.abs(now.qpos[0]) > 2.2)

    return sim.env(spec, reset, step)


if __name__ == "__main__":
    settings = ("num_envs=128", "num_timesteps=400e3", *sys.argv[1:])
    gmijax.train(gmijax.compose(*settings, env=make), show=True)

"""Laws that no task's physics may break, over all tasks: energy, and that bodies are solid."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from compiled_tasks import NUM_ENVS, NUM_STARTS, CompiledTask, on_device
from task_cases import CASES

from gmijax.sim import physics

STEPS = 1000


def passive(model: Any) -> Any:
    """The model [mjx.Model] without motors and without damping.

    Its contacts rub, which can only take energy; without friction MJX divides by its square.
    """
    zeroed = ("dof_damping", "dof_frictionloss", "actuator_gainprm", "actuator_biasprm")
    return model.tree_replace({name: jnp.zeros_like(getattr(model, name)) for name in zeroed})


def test_a_passive_robot_gains_no_energy(task: CompiledTask):
    start, model = task.start(seed=7).env.physics, passive(task.converged.model)
    qpos, push = (
        start.qpos[:NUM_STARTS],
        np.random.default_rng(0).normal(0.0, 0.3, start.qvel.shape),
    )
    qvel = start.qvel[:NUM_STARTS] + jnp.asarray(push[:NUM_STARTS], jnp.float32)
    state = on_device(physics.PhysicsState(qpos, qvel, jnp.zeros_like(qvel)))
    ctrl = jnp.zeros((NUM_STARTS, task.mj_model.nu))
    energies = [energy(task.mj_model, state)]
    for _ in range(STEPS):
        state, _ = task.converged_step(model, state, ctrl)
        state = state._replace(overflow=None)
        energies.append(energy(task.mj_model, state))
    gained = (np.array(energies) - energies[0]).sum(axis=2)
    assert np.isfinite(gained).all()
    moving = np.array(energies)[..., 1].max()
    assert gained.max() < CASES[task.env.spec.name].energy_gain * moving


def energy(mj_model: mujoco.MjModel, state: physics.PhysicsState) -> np.ndarray:
    """Potential and kinetic energy of environments, joules [NUM_STARTS, 2]."""
    qpos, qvel = np.asarray(state.qpos), np.asarray(state.qvel)
    data, found = mujoco.MjData(mj_model), []
    held = mj_model.body_gravcomp * mj_model.body_mass
    for index in range(NUM_STARTS):
        data.qpos, data.qvel = qpos[index], qvel[index]
        mujoco.mj_fwdPosition(mj_model, data)
        mujoco.mj_fwdVelocity(mj_model, data)
        mujoco.mj_energyPos(mj_model, data)
        mujoco.mj_energyVel(mj_model, data)
        # A body whose weight is carried has no potential energy.
        carried = held @ (data.xipos @ mj_model.opt.gravity)
        found.append((data.energy[0] + carried, data.energy[1]))
    return np.array(found)


def test_bodies_do_not_sink_into_each_other(task: CompiledTask):
    state, deepest, rng = task.start(seed=3), 0.0, np.random.default_rng(0)
    shape, first = (NUM_ENVS, task.env.spec.action_size), state.env.steps
    for _ in range(STEPS):
        actions = jnp.asarray(rng.uniform(-1, 1, shape), jnp.float32)
        state, _ = task.step(task.env.model, state, actions)
        # Else a new episode would begin every few steps.
        state = state._replace(env=state.env._replace(steps=first))
        deepest = max(deepest, depth(task.mj_model, np.asarray(state.env.physics.qpos)))
    assert 0.0 < deepest < CASES[task.env.spec.name].penetration_m


def depth(mj_model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """How deep the deepest contact of environments `qpos` [N, nq] is, metres."""
    data, deepest = mujoco.MjData(mj_model), 0.0
    for row in qpos:
        data.qpos = row
        mujoco.mj_fwdPosition(mj_model, data)
        if data.ncon:
            deepest = max(deepest, -float(data.contact.dist.min()))
    return deepest

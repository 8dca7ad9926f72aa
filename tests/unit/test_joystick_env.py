"""Playground's joystick tasks in plain MuJoCo: observations are those of Playground itself."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
import pytest
from stand_in_models import make_stand_ins

from gmijax.player.deployment import deployment_of
from gmijax.player.joystick import ROBOTS
from gmijax.player.joystick_env import JoystickEnv
from gmijax.player.joystick_model import joystick_model

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_playground") is None, reason="needs playground"
)


@pytest.fixture(autouse=True)
def models(tmp_path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    return tmp_path


def both(robot: str, terrain: str, models) -> tuple[Any, JoystickEnv]:
    """Playground's task without noise and pushes, and ours with the metadata of its export."""
    from gmijax.sim.adapters.playground import configuration, import_playground
    from gmijax.sim.robots import ROBOT_SETTINGS, playground_name
    from gmijax.sim.tasks.settings import settings_from

    task = playground_name(robot if terrain == "flat" else f"{robot}_rough")
    make_stand_ins(models, task, robot)
    settings = {"noise": 0.0, "push": 0.0}
    config = configuration(robot, settings)
    changes = settings_from(ROBOT_SETTINGS[robot], settings).overrides() | {"impl": "jax"}
    theirs = import_playground().registry.load(task, config_overrides=changes)
    about = deployment_of(ROBOTS[robot], theirs.mj_model, config)
    model = joystick_model(ROBOTS[robot], terrain)
    return theirs, JoystickEnv(about, model, np.random.default_rng(0), pushes=False)


class TheirsOnOurPhysics:
    """Playground's own code for a task, on what plain MuJoCo computes for ours."""

    def __init__(self, theirs: Any, ours: JoystickEnv, monkeypatch) -> None:
        self.theirs, self.ours = theirs, ours
        self.targets = np.zeros(0)
        mjx_env = importlib.import_module("mujoco_playground._src.mjx_env")
        monkeypatch.setattr("mujoco.mjx.forward", lambda model, data: self._data(data))
        monkeypatch.setattr(mjx_env, "step", self._step)

    def _step(self, model, data, targets, substeps):
        assert substeps * self.ours.model.opt.timestep == pytest.approx(0.02)
        self.targets = np.asarray(targets)
        return self._data(data)

    def _data(self, data):
        import jax.numpy as jnp

        ours = self.ours.data
        names = ("qpos", "qvel", "sensordata", "site_xpos", "actuator_force", "xfrc_applied")
        values = {name: jnp.asarray(getattr(ours, name), jnp.float32) for name in names}
        axes = jnp.asarray(ours.site_xmat.reshape(-1, 3, 3), jnp.float32)
        return data.replace(site_xmat=axes, **values)


@pytest.mark.parametrize("robot", ["go1", "g1", "t1", "spot"])
def test_observations_are_those_of_playground_at_the_same_states(robot, models, monkeypatch):
    import jax

    theirs, ours = both(robot, "flat", models)
    shared = TheirsOnOurPhysics(theirs, ours, monkeypatch)
    rng = np.random.default_rng(1)
    state = theirs.reset(jax.random.PRNGKey(0))
    ours.command = state.info["command"]
    if "phase_dt" in state.info:
        ours.gait_hz = float(state.info["phase_dt"][0]) / (2 * np.pi * 0.02)
    assert ours.observe() == pytest.approx(np.asarray(state.obs["state"]), abs=1e-5)
    for number in range(6):
        action = rng.uniform(-1, 1, ours.model.nu).astype(np.float32)
        obs, step = ours.step(action)
        told = state.info["command"]
        state = theirs.step(state, action)
        assert obs == pytest.approx(np.asarray(state.obs["state"]), abs=1e-5)
        low, high = ours.model.actuator_ctrlrange.T
        assert ours.data.ctrl == pytest.approx(np.clip(shared.targets, low, high), abs=1e-6)
        assert step.command[0, 0] == pytest.approx(np.asarray(told))
        assert bool(step.done[0, 0]) == bool(state.done)
        if number == 2:  # Another command, which both see one step later.
            state.info["command"] = jax.numpy.array([0.3, -0.2, 0.1])
        ours.command = state.info["command"]

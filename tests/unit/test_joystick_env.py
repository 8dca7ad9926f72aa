"""Playground's joystick tasks in plain MuJoCo: observations are those of Playground itself."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import json
import runpy
import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from stand_in_models import make_stand_ins

from gmijax.config import EnvConfig
from gmijax.deploy.policy import Policy
from gmijax.errors import ConfigError
from gmijax.player.deployment import deployment_of
from gmijax.player.joystick import ROBOTS, Ground
from gmijax.player.joystick_draws import Commands
from gmijax.player.joystick_env import JoystickEnv
from gmijax.player.joystick_model import joystick_model
from gmijax.player.walking import Recording, measure

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_playground") is None, reason="needs playground"
)


@pytest.fixture(autouse=True)
def models(tmp_path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    return tmp_path


def configured(robot: str, models, **settings) -> tuple[Any, dict[str, Any]]:
    """Playground's task, and the metadata of its export."""
    from gmijax.sim.adapters.playground import configuration
    from gmijax.sim.adapters.playground_package import import_playground
    from gmijax.sim.robots import ROBOT_SETTINGS, playground_name
    from gmijax.sim.tasks.settings import settings_from

    task = playground_name(robot)
    make_stand_ins(models, task, robot)
    changes = settings_from(ROBOT_SETTINGS[robot], settings).overrides() | {"impl": "jax"}
    theirs = import_playground().registry.load(task, config_overrides=changes)
    about = deployment_of(ROBOTS[robot], theirs.mj_model, configuration(robot, settings))
    return theirs, about


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

    theirs, about = configured(robot, models, noise=0.0, push=0.0)
    ours = JoystickEnv(about, "flat", np.random.default_rng(0), pushes=False, noise=False)
    for name in ("timestep", "ccd_iterations", "iterations", "ls_iterations", "integrator"):
        assert getattr(ours.model.opt, name) == getattr(theirs.mj_model.opt, name), name
    shared = TheirsOnOurPhysics(theirs, ours, monkeypatch)
    rng = np.random.default_rng(1)
    state = theirs.reset(jax.random.PRNGKey(0))
    ours.command = state.info["command"]
    if "phase_dt" in state.info:
        ours.gait_hz = float(state.info["phase_dt"][0]) / (2 * np.pi * 0.02)
    assert ours.observe() == pytest.approx(np.asarray(state.obs["state"]), abs=1e-5)
    for number in range(9):
        action = rng.uniform(-1, 1, ours.model.nu).astype(np.float32)
        obs, step = ours.step(action)
        command = state.info["command"]
        state = theirs.step(state, action)
        assert obs == pytest.approx(np.asarray(state.obs["state"]), abs=1e-5)
        low, high = ours.model.actuator_ctrlrange.T
        assert ours.data.ctrl == pytest.approx(np.clip(shared.targets, low, high), abs=1e-6)
        assert step.command[0, 0] == pytest.approx(np.asarray(command))
        assert bool(step.done[0, 0]) == bool(state.done)
        if number == 2:  # Another command, which both see one step later.
            state.info["command"] = jax.numpy.array([0.3, -0.2, 0.1])
        if number == 3:  # T1 stops its clock, and both legs go on in phase.
            state.info["command"] = jax.numpy.zeros(3)
        if number == 5:
            state.info["command"] = jax.numpy.array([0.3, -0.2, 0.1])
        ours.command = state.info["command"]
        if robot in ("g1", "t1") and number in (4, 5, 7):
            cosines = obs[-4:-2]
            # The clock is read one step late.
            assert bool(cosines[0] == pytest.approx(cosines[1])) == (robot == "t1" and number > 4)


def played(env: JoystickEnv, steps: int) -> Recording:
    """One start without any action."""
    env.reset()
    recorded = [env.step(np.zeros(env.model.nu))[1] for _ in range(steps)]
    return Recording(*(np.concatenate(parts) for parts in zip(*recorded, strict=True)))


def test_go1_at_rest_stands_and_a_limp_one_falls_though_the_task_goes_on(models):
    _, about = configured("go1", models)
    env = JoystickEnv(about, "flat", np.random.default_rng(1), pushes=False, noise=False)
    walk = measure(played(env, 100), env.robot, Ground(env.model), env.control_dt_s)
    assert (walk.upright, walk.left) == (1.0, 0.0)
    assert walk.load_rms is not None
    assert 0.05 < walk.load_rms < 0.5
    limp = JoystickEnv(
        {**about, "kp_n_m_per_rad": [0.0] * 12}, "rough", np.random.default_rng(0), pushes=False
    )
    walk = measure(played(limp, 100), limp.robot, Ground(limp.model), limp.control_dt_s)
    assert (walk.upright, walk.not_done) == (0.0, 1.0)
    assert walk.falls["low"] == 1


def test_a_foot_that_hits_rough_ground_does_not_sink_into_it(models):
    make_stand_ins(models, "Go1JoystickRoughTerrain", "go1")
    model = joystick_model(ROBOTS["go1"], "rough")
    data, ground, rng = mujoco.MjData(model), Ground(model), np.random.default_rng(0)
    feet = [model.geom(name).id for name in ("FR", "FL", "RR", "RL")]
    deepest_m = 0.0
    for _ in range(12):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[:3] += *rng.uniform(-5, 5, 2), 1.0
        data.qvel[0] = 2.0
        for _ in range(250):
            mujoco.mj_step(model, data)
            x, y, z = data.geom_xpos[feet].T
            depth_m = ground.height_m(np.stack([x, y], -1)) + model.geom_size[feet, 0] - z
            deepest_m = max(deepest_m, depth_m.max())
    # With the detector that lets them sink it is 0.08 m.
    assert deepest_m < 0.06


def test_bad_numbers_are_a_fall_and_no_new_start(models):
    _, about = configured("go1", models)
    env = JoystickEnv(about, "flat", np.random.default_rng(0))
    env.data.qvel[3] = np.nan
    steps = [env.step(np.zeros(12))[1] for _ in range(2)]
    together = Recording(*(np.concatenate(parts) for parts in zip(*steps, strict=True)))
    walk = measure(together, env.robot, Ground(env.model), env.control_dt_s)
    assert walk.falls["not_finite"] == 1


def test_commands_are_drawn_as_in_training(models):
    _, about = configured("go1", models, command_forward_m_per_s=0.7)
    commands = Commands(about, np.random.default_rng(0))
    command, seen = commands.begin(), []
    for _ in range(50_000):
        new = commands.next(command)
        seen.append(new)
        command = new
    seen = np.array(seen)
    largest = np.abs(seen).max(0) / [0.7, 0.8, 1.2]
    assert (largest > 0.9).all()
    assert (largest <= 1.0).all()
    # An axis changes with one half, and is then not zero with 0.9, 0.25, 0.5.
    assert (seen != 0).mean(0) == pytest.approx([0.9, 0.25, 0.5], abs=0.12)
    # New ones come every 5 s; in two of three an axis changes that is not zero before and after.
    changed = (np.diff(seen, axis=0) != 0).any(-1)
    assert 0.5 < changed.mean() / (0.02 / 5.0) < 1.0


def test_a_humanoids_commands_last_501_steps_and_one_in_ten_is_zero(models):
    _, about = configured("g1", models)
    commands = Commands(about, np.random.default_rng(0))
    command, ends = commands.begin(), []
    for step in range(501 * 400):
        new = commands.next(command)
        if not np.array_equal(new, command):
            ends.append(step)
        command = new
    assert len(ends) > 300
    assert set(np.diff(ends)) <= {501, 1002, 1503}
    draws = np.array([commands.begin() for _ in range(2000)])
    assert (draws == 0).all(-1).mean() == pytest.approx(0.1, abs=0.03)
    assert np.abs(draws).max(0) == pytest.approx([1.0, 0.5, 1.0], abs=0.01)


def test_pushes_are_forces_of_go1_and_changes_of_velocity_of_g1(models):
    _, about = configured("go1", models, push_min_m_per_s=2.0, push_max_m_per_s=2.0)
    env = JoystickEnv(about, "flat", np.random.default_rng(3))
    forces = []
    for _ in range(400):
        env.step(np.zeros(12))
        forces.append(np.linalg.norm(env.data.xfrc_applied[env.model.body("trunk").id, :3]))
    pushed = np.array(forces) > 0
    assert 0 < pushed.mean() < 0.3
    (begins,) = np.nonzero(np.diff(pushed.astype(int)) == 1)
    assert ((np.diff(begins) * 0.02 > 1.0) & (np.diff(begins) * 0.02 < 3.3)).all()
    # A push changes the velocity by 1/pi of what was drawn, which can only be 2 m/s here.
    mass_kg = env.model.body_subtreemass[1]
    ends = [number for number in begins if number + 12 < len(forces)]
    changes = [sum(forces[number : number + 12]) * 0.02 / mass_kg for number in ends]
    assert changes == pytest.approx([2.0 / np.pi] * len(ends), rel=0.2)
    others = np.delete(np.arange(env.model.nbody), env.model.body("trunk").id)
    pushed_others = set()
    for _ in range(200):
        env.step(np.zeros(12))
        if env.data.xfrc_applied.any():
            pushed_others.add(bool(env.data.xfrc_applied[others].any()))
    assert pushed_others == {False}
    _, about = configured("g1", models)
    env = JoystickEnv(about, "flat", np.random.default_rng(0))
    steps = played(env, 520)
    kicks = np.flatnonzero(steps.disturbed[:500, 0])  # Its command is drawn anew after 501.
    assert 1 <= len(kicks) <= 2
    assert 250 <= kicks[0] + 1 <= 500


def test_errors_of_spots_joints_have_the_noise_that_was_measured(models):
    _, about = configured("spot", models)
    env = JoystickEnv(about, "flat", np.random.default_rng(0), pushes=False)
    begin = {part["name"]: part["start"] for part in about["obs"]}
    seen = [env.step(np.zeros(12))[0] for _ in range(3)]
    measured = [obs[begin["joint_pos"] :][:12] for obs in seen]  # Targets are the default pose.
    errors = seen[-1][begin["joint_errors"] :][:36].reshape(3, 12)
    assert errors == pytest.approx(np.array(measured[::-1]), abs=1e-6)
    assert np.abs(measured[-1] + about["default_pose_rad"] - env.data.qpos[7:]).max() > 0.01


def test_rough_ground_is_refused_where_there_is_none(models):
    _, about = configured("spot", models)
    with pytest.raises(ConfigError, match="terrain=rough: spot has none"):
        JoystickEnv(about, "rough", np.random.default_rng(0))


def test_an_export_has_the_layout_unless_the_policy_sees_what_no_robot_does(models):
    from gmijax.workers.exporter import _robot

    theirs, _ = configured("go1", models)
    spec = SimpleNamespace(action_size=12)
    env: Any = SimpleNamespace(spec=spec, mj_model=theirs.mj_model)
    config = EnvConfig(
        suite="playground",
        name="go1",
        episode_length=None,
        settings={"action_scale_rad": 0.3, "push_max_m_per_s": 9.0},
    )
    found = json.loads(json.dumps(_robot(config, env, 48)))
    assert sum(length for _, length in found["obs_terms"]) == 48
    about = found["robot"]
    assert about["action_scale_rad"] == 0.3
    assert (about["history"], about["action_repeat"]) == (1, 1)
    assert about["settings"] == {"action_scale_rad": 0.3}
    assert (about["phase"], about["pushes"]["enabled"]) == (None, False)
    assert about["pushes"]["velocity_kick_m_per_s"] == [0.0, 3.0]
    assert about["default_pose_rad"][:3] == pytest.approx([0.1, 0.9, -1.8])
    assert set(about["kp_n_m_per_rad"]) == {35.0}
    assert about["torque_limit_n_m"][:3] == pytest.approx([23.7, 23.7, 35.55])
    late = [part["name"] for part in about["obs"] if part["delay_steps"]]
    assert late == ["last_action", "command"]
    ends = [part["start"] + part["length"] for part in about["obs"]]
    assert [part["start"] for part in about["obs"]] == [0, *ends[:-1]]
    assert _robot(config, env, 123) == {}
    assert _robot(dataclasses.replace(config, name="Go1Getup"), env, 48) == {}


def test_gains_are_those_of_motors_and_joints_together(models):
    _, about = configured("spot", models)
    assert set(about["kp_n_m_per_rad"]) == {300.0}
    assert about["kd_n_m_s_per_rad"] == pytest.approx([21.0] * 12)
    assert about["torque_limit_n_m"] == [None] * 12
    _, about = configured("g1", models)
    assert about["kd_n_m_s_per_rad"][:6] == pytest.approx([2, 2, 2, 2, 1, 0.2])
    assert about["torque_limit_n_m"][:2] == pytest.approx([88, 139])


def test_the_example_prints_the_walking_test(models, monkeypatch, capsys):
    _, about = configured("go1", models)
    about |= {"history": 1, "action_repeat": 1, "settings": {"noise": 0.5}}
    policy = Policy(lambda obs: np.zeros((len(obs), 12)), 48, 12, {"robot": about})
    monkeypatch.setattr("gmijax.load_policy", lambda path: policy)
    example = runpy.run_path("examples/sim2sim.py")
    line = ["sim2sim.py", "policy.onnx", "--terrain", "rough", "--envs", "2", "--seconds", "1"]
    monkeypatch.setattr("sys.argv", line)
    capsys.readouterr()  # What packages print as they are imported.
    assert example["main"]() == 0
    shown = capsys.readouterr().out
    assert shown.startswith("walking test: 2 environments, 1 s each")
    assert "not the task's own: noise=0.5\n" in shown
    assert shown.endswith("walks: too few to say (at least 100)\n")
    for options in (["--envs", "0"], ["--seconds", "0"]):
        monkeypatch.setattr("sys.argv", ["sim2sim.py", "policy.onnx", *options])
        with pytest.raises(ConfigError, match=r"at least --envs 1 and --seconds 0\.02$"):
            example["main"]()
    left = iter([True] * 60 + [False])  # The window is closed after 60 steps.
    window = SimpleNamespace(is_running=lambda: next(left), sync=lambda: None)
    viewer = SimpleNamespace(launch_passive=lambda model, data: nullcontext(window))
    monkeypatch.setattr("mujoco.viewer", viewer, raising=False)
    monkeypatch.setattr("sys.argv", ["sim2sim.py", "policy.onnx", "--view", "--seconds", "1"])
    started_s = time.monotonic()
    assert example["main"]() == 0
    assert next(left, None) is None
    assert time.monotonic() - started_s > 60 * about["control_dt_s"], "in real time"
    policy.metadata = {}
    with pytest.raises(ConfigError, match="not a policy of env=go1"):
        example["main"]()

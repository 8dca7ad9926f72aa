"""Robots of MuJoCo Playground, with meshes that stand in for those of MuJoCo Menagerie."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_checkpoint import ENV_STEPS, make_run
from stand_in_models import make_stand_ins

import gmijax
from gmijax.config.env import ROBOTS
from gmijax.config.schema import flatten
from gmijax.deploy.files import stablehlo_content
from gmijax.deploy.trained import trained_policy
from gmijax.errors import ConfigError
from gmijax.learning.walking import recorded, walking_env
from gmijax.player.joystick import ROBOTS as WALKERS
from gmijax.player.joystick import Ground, Readings
from gmijax.player.walking import Recording, measure
from gmijax.sim.interface import Env
from gmijax.sim.randomize import make_envs, randomized
from gmijax.sim.registry import make_env, require_env
from gmijax.sim.robot_models import has_randomizer, models_of
from gmijax.sim.robots import ROBOT_SETTINGS
from gmijax.sim.wrappers import BatchState, StepOutput, training_env
from gmijax.workers.exporter import names_of

playground: Any = pytest.importorskip("mujoco_playground")

SEED, NUM_ENVS = 3, 4

pytestmark = pytest.mark.timeout(600)


class Walked(NamedTuple):
    """Go1, randomised, in environments that have all started alike, and its first steps."""

    env: Env
    step: Callable[..., tuple[BatchState, StepOutput]]
    states: list[BatchState]
    output: StepOutput


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Stand-ins for the robots, where they are looked for."""
    root = tmp_path_factory.mktemp("models")
    for task in ("Go1", "G1", "T1", "Spot"):
        make_stand_ins(root, task, task.lower())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MENAGERIE_ROOT", str(root))
        yield


@pytest.fixture(scope="module")
def walked(models: None) -> Walked:
    config = gmijax.compose("env=go1", "env.randomize=on", "env.settings.push=1").env
    require_env(config)
    env = make_envs(config, "jax", seed=SEED, first_env=0, num_envs=NUM_ENVS)
    batch = training_env(env)
    alike = jax.random.split(jax.random.key(0), 1)[jnp.zeros(NUM_ENVS, int)]
    states = [jax.jit(batch.init)(env.model, alike)]
    step = jax.jit(batch.step)
    actions = jnp.zeros((NUM_ENVS, env.spec.action_size))
    for _ in range(5):
        state, output = step(env.model, states[-1], actions)
        states.append(state)
    return Walked(env, step, states, output)


def test_go1_starts_and_steps(walked: Walked) -> None:
    spec = walked.env.spec
    assert (spec.name, spec.obs_size, spec.actor_obs_size, spec.action_size) == (
        "go1",
        171,
        48,
        12,
    )
    assert (spec.control_dt_s, spec.episode_length) == (0.02, 1000)
    assert {"reward/tracking_lin_vel", "reward/tracking_ang_vel"} <= set(spec.metrics)
    assert walked.output.next_obs.shape == (NUM_ENVS, 171)
    assert np.isfinite(walked.output.next_obs).all()
    assert not np.asarray(walked.output.terminated).any()
    assert int(walked.output.diverged["any"]) == 0
    height = np.asarray(jax.vmap(walked.env.qpos)(walked.states[-1].env))[:, 2]
    assert ((height > 0.2) & (height < 0.4)).all(), "it stands"


def test_films_know_the_command_that_the_policy_sees(walked: Walked) -> None:
    state = walked.states[-1].env
    assert walked.env.command is not None
    command = np.asarray(jax.vmap(walked.env.command)(state))
    assert np.abs(command).max() > 0.1
    np.testing.assert_allclose(command, state.obs[:, 45:48])


def test_each_environment_has_the_model_that_playground_draws(walked: Walked) -> None:
    start, end = (
        np.asarray(jax.vmap(walked.env.qpos)(state.env))
        for state in (walked.states[0], walked.states[-1])
    )
    assert (start == start[0]).all()
    assert len(np.unique(end, axis=0)) == NUM_ENVS
    nominal = walked.env.mj_model
    friction = np.asarray(walked.env.model["geom_friction"])
    assert ((friction[:, 0, 0] >= 0.4) & (friction[:, 0, 0] <= 1.0)).all()
    np.testing.assert_allclose(friction[:, 1:], np.tile(nominal.geom_friction[1:], (4, 1, 1)))
    assert set(walked.env.model) == {
        *("body_ipos", "body_mass", "dof_armature", "dof_frictionloss"),
        *("geom_friction", "qpos0"),
    }


def test_several_gmis_have_the_environments_of_one(walked: Walked) -> None:
    second = randomized(walked.env, {}, seed=SEED, first_env=2, num_envs=2)
    for leaf, values in walked.env.model.items():
        np.testing.assert_array_equal(second.model[leaf], values[2:])


def test_the_walking_test_reads_what_playground_rewards(walked: Walked) -> None:
    robot = WALKERS["go1"]
    readings = Readings(walked.env.mj_model, robot)
    pairs = list(pairwise(state.env for state in walked.states))
    parts = zip(*(recorded(readings, *pair) for pair in pairs), strict=True)
    steps = Recording(*(np.stack(part) for part in parts))
    # What the value function sees has no noise: behind the 48 numbers of the policy they come
    # again, then gyro, accelerometer, gravity and velocity. The command is that of the step.
    obs = np.stack([after.obs for _, after in pairs])
    seen = np.concatenate([obs[..., 105:107], obs[..., 98:99]], -1)
    np.testing.assert_allclose(steps.velocity, seen, atol=1e-6)
    np.testing.assert_array_equal(steps.command, obs[..., 45:48])
    effort = np.abs(obs[..., 135:147]) / readings.torque_limit_n_m
    np.testing.assert_allclose(steps.load, effort, atol=1e-4)
    walk = measure(steps, robot, Ground(walked.env.mj_model), walked.env.spec.control_dt_s)
    assert (walk.num_envs, walk.upright, walk.walks) == (NUM_ENVS, 1.0, None)
    assert walk.all_steps.linear_m_per_s is not None
    assert walk.settled.linear_m_per_s is None


def test_the_walking_test_sees_playgrounds_pushes(walked: Walked) -> None:
    readings = Readings(walked.env.mj_model, WALKERS["go1"])
    trunk = walked.env.mj_model.body("trunk").id
    before = walked.states[-1]
    pushed, disturbed, redrawn = [], [], []
    for _ in range(160):  # The first push comes after 1 to 3 s.
        actions = jnp.zeros((NUM_ENVS, walked.env.spec.action_size))
        after, _ = walked.step(walked.env.model, before, actions)
        forces = np.asarray(after.env.physics.data.xfrc_applied)
        assert not np.delete(forces, trunk, 1).any()
        pushed.append(forces[:, trunk].any(-1))
        disturbed.append(np.asarray(recorded(readings, before.env, after.env).disturbed))
        commands = [np.asarray(state.env.task.info["command"]) for state in (before, after)]
        redrawn.append((commands[0] != commands[1]).any(-1))
        before = after
    assert np.any(pushed, axis=0).all(), "every robot is pushed"
    np.testing.assert_array_equal(disturbed, np.logical_or(pushed, redrawn))


def test_the_walking_test_asks_for_pushes(monkeypatch: pytest.MonkeyPatch, models: None) -> None:
    configured: dict[str, Any] = {}

    def load(task: str, config_overrides: dict[str, Any]) -> None:
        configured.update(config_overrides)
        raise ValueError("enough")

    monkeypatch.setattr(playground.registry, "load", load)
    for name, key in (("go1", "pert_config.enable"), ("g1", "push_config.enable")):
        task = gmijax.compose(f"env={name}", "env.settings.push=0", "env.settings.noise=0.5").env
        with pytest.raises(ConfigError, match="enough"):
            walking_env(task, WALKERS[name], "jax", NUM_ENVS)
        assert configured[key] is True
        assert configured["noise_config.level"] == 0.5


def test_a_policy_for_go1_is_exported(walked: Walked, tmp_path: Path) -> None:
    sizes = {"obs_size": 171, "action_size": 12, "actor_obs_size": 48}
    run = make_run(tmp_path / "run", "env=go1", "tuned=go1_ppo", **sizes)
    about = names_of(walked.env)
    assert about["action_names"][:3] == ["FR_hip", "FR_thigh", "FR_calf"]
    assert about["joint_names"][1:3] == ["FR_hip_joint", "FR_thigh_joint"]
    assert about["control_dt_s"] == 0.02
    file = tmp_path / "policy.stablehlo"
    file.write_bytes(stablehlo_content(trained_policy(run.checkpoint(ENV_STEPS))))
    obs = np.random.default_rng(0).normal(size=(3, 48)).astype(np.float32)
    np.testing.assert_allclose(
        gmijax.load_policy(file)(obs), gmijax.load_policy(run.root)(obs), atol=1e-6
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_what_is_written_here_is_what_playground_has(name: str) -> None:
    config = playground.registry.get_default_config(ROBOTS[name])
    defaults = flatten(config.to_dict())
    for key, value in ROBOT_SETTINGS[name]().overrides().items():
        assert type(defaults[key]) is type(value), key
        assert defaults[key] == pytest.approx(value), key
    assert gmijax.compose(f"env={name}").env.rewards == dict(config.reward_config.scales)
    assert config.episode_length == 1000
    positive = ("scale", "sigma")
    least = {
        field: 0.0
        for field in vars(ROBOT_SETTINGS[name]())
        if not any(word in field for word in positive)
    }
    changed = ROBOT_SETTINGS[name](**least, tracking_sigma=0.5).overrides()
    config.lock().update_from_flattened_dict(changed)
    found = flatten(config.to_dict())
    zero = [key for key in changed if not any(word in key for word in positive)]
    assert not any(np.any(found[key]) for key in zero)
    assert found["reward_config.tracking_sigma"] == 0.5


@pytest.mark.parametrize("name", ROBOTS)
def test_tuned_settings_are_those_that_playground_ships(name: str) -> None:
    params = importlib.import_module("mujoco_playground.config.locomotion_params")
    wanted, config = params.brax_ppo_config(ROBOTS[name]), gmijax.compose(f"env={name}")
    algo: Any = config.algo
    same = ("num_minibatches", "num_updates_per_batch", "discounting", "learning_rate")
    for key in (*same, "entropy_cost", "max_grad_norm", "reward_scaling"):
        assert getattr(algo, key) == pytest.approx(wanted[key]), key
    assert (config.num_envs, config.num_timesteps) == (wanted.num_envs, wanted.num_timesteps)
    assert algo.clipping_epsilon == wanted.get("clipping_epsilon", 0.3)
    collected = wanted.unroll_length * wanted.batch_size * wanted.num_minibatches
    assert algo.unroll_length * config.num_envs == collected
    networks = wanted.network_factory
    assert algo.policy_hidden_layer_sizes == networks.policy_hidden_layer_sizes
    assert algo.value_hidden_layer_sizes == networks.value_hidden_layer_sizes
    assert (algo.value_obs_key == "state") == (networks.value_obs_key == "state")


@pytest.mark.parametrize(
    ("name", "max_envs", "contacts", "rows"),
    [
        ("go1", None, 4 * 8192, 40),
        ("go1", 16384, 4 * 16384, 40),
        ("go1_rough", 1024, 8 * 8192, 60),
        ("go1_rough", 16384, 8 * 16384, 60),
        ("g1_rough", 16384, 16 * 16384, 128),
    ],
)
def test_buffers_of_warp_grow_with_the_environments(
    monkeypatch: pytest.MonkeyPatch, name: str, max_envs: int | None, contacts: int, rows: int
) -> None:
    configured: dict[str, Any] = {}

    def load(task: str, config_overrides: dict[str, Any]) -> None:
        configured.update(config_overrides, task=task)
        raise ValueError("enough")

    monkeypatch.setattr(playground.registry, "load", load)
    with pytest.raises(ConfigError, match=f"^env.name={name} fails: ValueError: enough"):
        make_env(name, max_envs=max_envs)
    # By overrides: the constructor of Go1's task writes over what a configuration has.
    assert (configured["naconmax"], configured["njmax"]) == (contacts, rows)
    assert (configured["task"], configured["impl"]) == (ROBOTS[name], "jax")


def test_models_and_randomisers_are_known_for_every_task() -> None:
    registry = playground.registry
    for suite in (playground.locomotion, playground.manipulation):
        for task in suite.ALL_ENVS:
            assert models_of(task), task
            assert has_randomizer(task) == (registry.get_domain_randomizer(task) is not None)
    for task in playground.dm_control_suite.ALL_ENVS:
        assert not models_of(task)
        assert not has_randomizer(task)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"settings": {"noise_config.levl": 1.0}},
            "^env.settings.noise_config.levl: no such number: did you mean noise_config.level",
        ),
        ({"settings": {"x": 1.0}}, "^env.settings.x: no such number; allowed: Kd, Kp, action_"),
        ({"settings": {"pert_config.enable": 2.0}}, "pert_config.enable=2.0: must be 0 or 1$"),
        ({"settings": {"history_len": 1.5}}, "history_len=1.5: must be a whole number$"),
        ({"rewards": {"torqes": 1.0}}, "^env.rewards.torqes: .* no such term: did you mean torq"),
    ],
)
def test_what_other_tasks_do_not_have_is_one_line(
    options: Any, message: str, models: None
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_env("Go1JoystickFlatTerrain", suite="playground", **options)


def test_a_missing_model_is_reported_by_the_gmi_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MENAGERIE_ROOT", "/nowhere")
    with pytest.raises(ConfigError, match=r"^MENAGERIE_ROOT=/nowhere has no model google_bark"):
        make_env("BarkourJoystick", suite="playground")

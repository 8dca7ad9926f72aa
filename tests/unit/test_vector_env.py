"""Our environments with the vector interface of Gymnasium."""

from __future__ import annotations

import functools
import importlib.util
import math
import sys
import warnings
from collections import Counter
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from toy_env import point_mass_env, walker

from gmijax.errors import ConfigError
from gmijax.machine import opengl
from gmijax.sim import registry
from gmijax.sim.adapters import pictures
from gmijax.sim.adapters.to_gymnasium import GmijaxVectorEnv
from gmijax.sim.registry import make_env
from gmijax.sim.vector_envs import make_vector_env

NUM_ENVS, LENGTH = 4, 5
STILL = np.zeros((NUM_ENVS, 1), np.float32)

torch_too = pytest.param(
    "torch",
    marks=pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="no torch here"),
)


def made(**options: Any) -> GmijaxVectorEnv:
    return GmijaxVectorEnv(point_mass_env(LENGTH), NUM_ENVS, **options)


@pytest.fixture(scope="module")
def envs() -> GmijaxVectorEnv:
    return made()


@pytest.fixture(scope="module")
def next_step() -> GmijaxVectorEnv:
    return made(autoreset="next_step")


@pytest.fixture(scope="module")
def disabled() -> GmijaxVectorEnv:
    return made(autoreset="disabled")


def random_actions(envs: Any, seed: int) -> np.ndarray:
    envs.action_space.seed(seed)
    return envs.action_space.sample()


def leaves(tree: Any) -> list[Any]:
    return jax.tree.leaves(tree)


def test_shapes_and_types_are_those_of_the_spaces(envs: GmijaxVectorEnv):
    obs, info = envs.reset(seed=0)
    assert envs.num_envs == NUM_ENVS
    assert (envs.single_observation_space.shape, envs.single_action_space.shape) == ((2,), (1,))
    assert info == {}
    assert obs in envs.observation_space
    for step in range(LENGTH):
        obs, reward, terminated, truncated, info = envs.step(random_actions(envs, step))
    assert obs in envs.observation_space
    assert info["final_obs"] in envs.observation_space
    assert (reward.shape, reward.dtype) == ((NUM_ENVS,), np.float32)
    for flags in (terminated, truncated, info["_final_obs"], info["is_diverged"]):
        assert isinstance(flags, np.ndarray)
        assert (flags.shape, flags.dtype) == ((NUM_ENVS,), np.bool_)


def test_the_task_and_its_time_limit_are_known(envs: GmijaxVectorEnv):
    assert envs.episode_length == LENGTH
    assert envs.spec is not None
    assert (envs.spec.id, envs.spec.max_episode_steps) == ("gmijax/point_mass", LENGTH)
    assert envs.metadata["render_fps"] == pytest.approx(10.0)
    # As one of Brax that does not say how long a step is; and the name of a file's task.
    env = point_mass_env(LENGTH)
    odd = env._replace(spec=env.spec._replace(control_dt_s=math.nan, name="a b.py:make"))
    fresh = GmijaxVectorEnv(odd, NUM_ENVS)
    assert fresh.spec is not None
    assert fresh.spec.id == "gmijax/a_b.py_make"
    assert "render_fps" not in fresh.metadata


@pytest.mark.parametrize("arrays", ["numpy", torch_too])
def test_what_is_handed_out_is_the_callers_own(arrays: Any):
    def returns(spoils: bool) -> list[float]:
        envs = made(arrays=arrays)
        obs, _ = envs.reset(seed=0)
        seen = [float(obs.sum())]
        for step in range(2 * LENGTH):
            actions = np.full((NUM_ENVS, 1), 0.1 * step, np.float32)
            handed = envs.step(actions)
            actions[:] = 9.0
            seen += [float(leaf.sum()) for leaf in leaves(handed)]
            for leaf in leaves((obs, handed)) if spoils else ():
                leaf[:] = 1
            obs = handed[0]
        return seen

    assert returns(spoils=True) == returns(spoils=False)


@pytest.mark.parametrize("arrays", ["numpy", "jax", torch_too])
@pytest.mark.parametrize("autoreset", ["same_step", "next_step", "disabled"])
def test_a_step_is_compiled_once(arrays: Any, autoreset: Any):
    env, traced = point_mass_env(LENGTH), Counter[str]()

    def counted(name: str) -> Any:
        def called(*given: Any) -> Any:
            traced[name] += 1
            return getattr(env, name)(*given)

        return called

    own = env._replace(reset=counted("reset"), step=counted("step"))
    envs = GmijaxVectorEnv(own, NUM_ENVS, arrays=arrays, autoreset=autoreset)
    mask = np.array([True, False, False, True])
    kinds: list[Any] = [STILL, jnp.asarray(STILL), STILL.tolist(), STILL.astype(np.float64)]
    if arrays == "torch":
        torch = pytest.importorskip("torch")
        kinds += [torch.zeros((NUM_ENVS, 1)), torch.zeros((NUM_ENVS, 1), requires_grad=True)]
    once: Counter[str] | None = None
    for _ in range(2):
        for options in (None, {"reset_mask": mask}):
            envs.reset(options=options)
            for actions in kinds if once else kinds[:1]:
                envs.step(actions)
        once = once or traced.copy()
    assert traced == once
    assert set(traced) == {"reset", "step"}


def test_an_environment_starts_over_in_the_step_that_ends_its_episode(envs: GmijaxVectorEnv):
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    before, _ = envs.reset(seed=0)
    rewards = np.zeros(NUM_ENVS)
    for step in range(1, 2 * LENGTH + 1):
        obs, reward, terminated, truncated, info = envs.step(STILL)
        rewards += reward
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step % LENGTH == 0)
        # A point that is not pushed stays where it is; a new episode begins elsewhere.
        assert (obs == before).all() == (not truncated.any())
        # As Gymnasium has it: only where an episode has ended.
        assert ("final_obs" in info) == ("final_info" in info) == truncated.any()
        if truncated.any():
            np.testing.assert_array_equal(info["final_obs"], before)
            assert info["_final_obs"].all()
            assert info["_final_info"].all()
            np.testing.assert_allclose(info["final_info"]["episode"]["r"], rewards, rtol=1e-6)
            assert (info["final_info"]["episode"]["l"] == LENGTH).all()
            rewards[:] = 0
        before = obs


def test_on_a_device_the_last_observations_are_always_there():
    envs = made(arrays="jax")
    envs.reset(seed=0)
    info = envs.step(STILL)[-1]
    assert isinstance(info["final_obs"], jax.Array)
    assert not info["_final_obs"].any()


def test_next_step_resets_in_the_step_after_the_end(next_step: GmijaxVectorEnv):
    assert next_step.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    start, _ = next_step.reset(seed=0)
    push = np.ones_like(STILL)
    for step in range(1, 2 * LENGTH + 3):
        at = step % (LENGTH + 1)
        obs, reward, terminated, truncated, info = next_step.step(STILL if at else push)
        assert set(info) == {"is_diverged"}
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (at == LENGTH)
        assert (obs == start).all() == (at != 0)
        # The step of a reset ignores the action, and earns nothing.
        assert (reward == 0).all() == (at == 0)
        start = obs


def test_modes_agree_on_all_that_is_not_a_reset(
    envs: GmijaxVectorEnv, next_step: GmijaxVectorEnv, disabled: GmijaxVectorEnv
):
    start, _ = envs.reset(seed=3)
    for others in (next_step, disabled):
        np.testing.assert_array_equal(others.reset(seed=3)[0], start)
    # Three programs: they may round differently.
    same: Any = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    for step in range(LENGTH):
        actions = random_actions(envs, step)
        ends = [one.step(actions) for one in (envs, next_step, disabled)]
        for part in (1, 2, 3):
            same(ends[0][part], ends[1][part])
            same(ends[0][part], ends[2][part])
    same(ends[0][-1]["final_obs"], ends[1][0])
    same(ends[1][0], ends[2][0])
    same(next_step.step(STILL)[0], ends[0][0])


def test_without_autoreset_an_environment_waits_for_its_reset(disabled: GmijaxVectorEnv):
    disabled.reset(seed=0)
    for _ in range(LENGTH):
        end, _, _, truncated, _ = disabled.step(STILL)
    assert truncated.all()
    obs, reward, _, truncated, _ = disabled.step(np.ones_like(STILL))
    np.testing.assert_array_equal(obs, end)
    assert truncated.all()
    assert not reward.any()
    mask = np.array([True, False, True, False])
    obs, _ = disabled.reset(options={"reset_mask": mask})
    assert ((obs != end).any(axis=1) == mask).all()
    _, reward, _, truncated, _ = disabled.step(STILL)
    np.testing.assert_array_equal(truncated, ~mask)
    np.testing.assert_array_equal(reward != 0, mask)


def test_a_mask_resets_no_other_environment(envs: GmijaxVectorEnv):
    envs.reset(seed=0)
    before = envs.step(STILL)[0]
    mask = np.array([False, True, False, False])
    seeds = [7, 8, 9, 10]
    obs, _ = envs.reset(seed=seeds, options={"reset_mask": mask})
    np.testing.assert_array_equal(obs[~mask], before[~mask])
    np.testing.assert_array_equal(obs[mask], envs.reset(seed=seeds)[0][mask])
    envs.reset(seed=0)
    envs.step(STILL)
    envs.reset(options={"reset_mask": mask})
    for _ in range(LENGTH - 1):
        truncated = envs.step(STILL)[3]
    np.testing.assert_array_equal(truncated, ~mask)


def test_a_seed_decides_the_episodes_and_none_draws_others(envs: GmijaxVectorEnv):
    first, again = envs.reset(seed=3)[0], envs.reset(seed=3)[0]
    other, later = envs.reset(seed=4)[0], envs.reset()[0]
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.stack([first, other, later]), axis=0)) == 3
    assert len(np.unique(first, axis=0)) == NUM_ENVS


def test_every_environment_may_have_a_seed_of_its_own(envs: GmijaxVectorEnv):
    first = envs.reset(seed=[1, 2, 2, 2**70])[0]
    second = envs.reset(seed=np.array([2, 1, 3, 4]))[0]
    np.testing.assert_array_equal(first[[0, 1, 1]], [second[1], second[0], first[2]])
    assert len(np.unique(first, axis=0)) == 3
    drawn = [envs.reset(seed=[1, None, None, 1])[0] for _ in range(2)]
    assert ((drawn[0] == drawn[1]).all(axis=1) == [True, False, False, True]).all()


def test_an_environment_that_diverges_says_so():
    envs = GmijaxVectorEnv(walker(9), 2)
    envs.reset(seed=0)
    _, reward, terminated, _, info = envs.step(np.array([[np.nan], [0.0]]))
    for flags in (terminated, info["is_diverged"], info["final_info"]["is_diverged"]):
        assert flags.tolist() == [True, False]
    assert reward.tolist() == [0.0, 1.0]


def test_wrappers_of_gymnasium_fit(envs: GmijaxVectorEnv, next_step: GmijaxVectorEnv):
    for inner in (envs, next_step):
        counted = wrappers.RecordEpisodeStatistics(inner)
        counted.reset(seed=0)
        total = np.zeros(NUM_ENVS)
        for step in range(LENGTH):
            _, reward, _, _, info = counted.step(random_actions(counted, step))
            total += reward
        np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
        assert (info["episode"]["l"] == LENGTH).all()


@pytest.mark.parametrize(
    "wrap",
    [
        lambda envs: wrappers.ClipReward(envs, 0.0, 0.1),
        wrappers.NormalizeReward,
        lambda envs: wrappers.RescaleAction(envs, np.float32(-2), np.float32(2)),
        wrappers.DictInfoToList,
        lambda envs: wrappers.NormalizeReward(wrappers.ClipAction(envs)),
        wrappers.RecordEpisodeStatistics,
    ],
)
def test_wrappers_that_write_into_arrays_fit(wrap: Any, envs: GmijaxVectorEnv):
    wrapped = wrap(envs)
    wrapped.reset(seed=0)
    for step in range(2 * LENGTH):
        wrapped.step(random_actions(wrapped, step))


@pytest.mark.parametrize(
    "wrap",
    [
        wrappers.NormalizeObservation,
        wrappers.FlattenObservation,
        lambda envs: wrappers.RescaleObservation(
            wrappers.TransformObservation(
                envs, np.tanh, single_observation_space=gym.spaces.Box(-1.0, 1.0, (2,))
            ),
            np.float32(0.0),
            np.float32(1.0),
        ),
        lambda envs: wrappers.DtypeObservation(envs, np.float64),
        lambda envs: wrappers.ReshapeObservation(envs, (2, 1)),
    ],
)
def test_wrappers_of_observations_fit_next_step(wrap: Any, next_step: GmijaxVectorEnv):
    wrapped = wrap(next_step)
    wrapped.reset(seed=0)
    for step in range(2 * LENGTH):
        obs = wrapped.step(random_actions(wrapped, step))[0]
        assert obs.shape == wrapped.observation_space.shape


def test_misuse_is_an_error(envs: GmijaxVectorEnv):
    fresh = made(arrays="jax")
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        fresh.step(STILL)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        fresh.reset(options={"reset_mask": np.ones(NUM_ENVS, bool)})
    envs.reset(seed=0)
    with pytest.raises(gym.error.InvalidAction, match=r"\(4, 2\): expected \(4, 1\)"):
        envs.step(np.zeros((NUM_ENVS, 2), np.float32))
    with pytest.raises(gym.error.Error, match="3 seeds: expected one for each of 4"):
        envs.reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reset_mask": [True]}, r"of type bool, shape \(1,\): expected bool, \(4,\)"),
        ({"reset_mask": [1, 0, 0, 0]}, "of type int64"),
        ({"difficulty": 3}, r"options \['difficulty'\]: allowed: reset_mask"),
    ],
)
def test_options_that_would_be_ignored_are_refused(
    options: dict[str, Any], message: str, envs: GmijaxVectorEnv
):
    envs.reset(seed=0)
    with pytest.raises(gym.error.Error, match=message):
        envs.reset(options=options)


@pytest.mark.parametrize(
    ("num_envs", "options", "message"),
    [
        (0, {}, "num_envs=0: must be at least 1"),
        ("4", {}, "num_envs='4': expected a whole number"),
        (4.0, {}, "num_envs=4.0: expected a whole number"),
        (None, {}, "num_envs=None: expected a whole number"),
        (4, {"arrays": "cupy"}, "arrays=cupy: expected one of numpy, torch, jax"),
        (
            4,
            {"autoreset": "later"},
            "autoreset=later: expected one of same_step, next_step, disabled",
        ),
        (4, {"api": "dm_env"}, "api=dm_env: expected one of gymnasium, sb3, rsl_rl"),
        (4, {"render_mode": "human"}, "render_mode=human: expected one of rgb_array"),
        (4, {"api": "sb3", "arrays": "jax"}, "api=sb3: its arrays are of numpy"),
        (4, {"api": "rsl_rl", "autoreset": "disabled"}, "its autoreset is same_step"),
        (4, {"api": "rsl_rl", "render_mode": "rgb_array"}, "not with api=rsl_rl"),
        (4, {}, r"pip install 'gmijax\[gymnasium\]'"),
    ],
)
def test_bad_input_or_a_missing_package_is_an_error(
    num_envs: Any, options: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=message):
        make_vector_env("ant", num_envs, **options)


@pytest.mark.parametrize(
    ("options", "missing", "message"),
    [
        ({"arrays": "torch"}, "torch", r"arrays=torch: needs torch \(pip install torch\)"),
        ({"api": "sb3"}, "stable_baselines3", r"api=sb3: needs stable-baselines3 \(pip install"),
        ({"api": "rsl_rl"}, "rsl_rl", r"api=rsl_rl: needs rsl-rl-lib \(pip install"),
    ],
)
def test_a_missing_library_is_an_error(
    options: dict[str, Any], missing: str, message: str, monkeypatch: pytest.MonkeyPatch
):
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == missing else there("gymnasium")
    )
    with pytest.raises(ConfigError, match=message):
        make_vector_env("ant", 4, **options)


@pytest.mark.parametrize("length", ["5", 2.5])
def test_a_length_that_is_no_number_is_an_error(length: Any):
    with pytest.raises(ConfigError, match=r"env\.episode_length=.*: expected a whole number"):
        make_env("ant", episode_length=length)


def test_a_slow_cpu_is_reported(monkeypatch: pytest.MonkeyPatch):
    env = point_mass_env(LENGTH)
    monkeypatch.setattr(registry, "missing_on_cpu", lambda *_: {"XLA_FLAGS": "--a=b"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        registry.warn_on_cpu(env)  # No physics in it.
    if jax.default_backend() == "cpu":
        with pytest.warns(UserWarning, match="XLA_FLAGS='--a=b'"):
            registry.warn_on_cpu(env._replace(mj_model=object()))


class PaintedStage:
    """Paints every picture into the same memory, as MuJoCo's renderer does."""

    def __init__(self, model: Any, size: tuple[int, int], camera: str | None) -> None:
        if model == "broken":
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")
        self._image = np.zeros((2, 2, 3), np.uint8)

    def picture(self, qpos: np.ndarray) -> np.ndarray:
        self._image[:] = round(10 * abs(float(qpos[0])))
        return self._image


def test_skrl_asks_every_environment(envs: GmijaxVectorEnv):
    assert envs.call("render") is None
    assert envs.call("episode_length") == (LENGTH,) * NUM_ENVS
    with pytest.raises(AttributeError, match="jump"):
        envs.call("jump")


def test_every_environment_has_its_picture(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pictures, "Stage", PaintedStage)
    env = point_mass_env(LENGTH)._replace(mj_model="a model")
    envs = GmijaxVectorEnv(env, NUM_ENVS, autoreset="next_step", render_mode="rgb_array")
    obs, _ = envs.reset(seed=0)
    for _ in range(LENGTH + 1):
        shown = envs.call("render")
        assert isinstance(shown, tuple)
        assert [image.max() for image in shown] == [round(10 * abs(float(x))) for x in obs[:, 0]]
        obs = envs.step(STILL)[0]
    for model, message in (("broken", "no OpenGL.*glGetError"), (None, "no model to draw")):
        with pytest.raises(ConfigError, match=message):
            GmijaxVectorEnv(env._replace(mj_model=model), 1, render_mode="rgb_array")


def test_opengl_is_chosen_before_mujoco_is_imported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco", object())
    with pytest.raises(ConfigError, match="mujoco was imported before; set MUJOCO_GL=egl"):
        make_vector_env("ant", 1, render_mode="rgb_array")
    monkeypatch.delitem(sys.modules, "mujoco")
    monkeypatch.setattr(opengl, "first_opengl", lambda tried: (None, "no libEGL"))
    with pytest.raises(ConfigError, match=r"no headless OpenGL.*the last one: no libEGL"):
        make_vector_env("ant", 1, render_mode="rgb_array")


def test_arrays_of_torch():
    torch = pytest.importorskip("torch")
    envs = made(arrays="torch")
    obs, _ = envs.reset(seed=0)
    assert isinstance(obs, torch.Tensor)
    obs, reward, terminated, _, info = envs.step(torch.zeros((NUM_ENVS, 1)))
    assert terminated.dtype == info["_final_obs"].dtype == torch.bool
    assert reward.dtype == torch.float32
    torch.testing.assert_close(obs, info["final_obs"])
    envs.reset(options={"reset_mask": torch.ones(NUM_ENVS, dtype=torch.bool)})

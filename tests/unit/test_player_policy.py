"""`policy.npz` does what the checkpoint beside it does; what is no policy is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_checkpoint import ACTION_SIZE, ENV_STEPS, OBS_SIZE, make_run

from gmijax.deploy.policy import load_policy
from gmijax.errors import ConfigError
from gmijax.player.policy import PlainPolicy, checkpoint_policy, read_policy, write_policy
from gmijax.runs.folder import POLICY


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("algo.distribution_type=tanh_normal", "algo.state_dependent_std=true"),
        ("algo.obs_std_floor=0.07",),
        ("algo.normalize_observations=false",),
        ("algo.activation=layer_norm_silu",),
    ],
)
def test_it_acts_as_the_checkpoint_does(tmp_path: Path, overrides: tuple[str, ...]):
    run = make_run(tmp_path / "run", *overrides)
    plain = checkpoint_policy(run.checkpoint(ENV_STEPS))
    obs = 3.0 * np.random.default_rng(0).normal(size=(64, OBS_SIZE)).astype(np.float32)
    wanted = load_policy(run.root)(obs)
    assert np.ptp(wanted) > 0.05
    np.testing.assert_allclose(plain(obs), wanted, atol=1e-5)
    np.testing.assert_allclose(plain(obs[0]), wanted[0], atol=1e-5)
    assert plain.about["env"]["name"] == "ball_balance"
    assert plain.about["env_steps"] == ENV_STEPS


def test_a_checkpoint_of_an_older_version_is_one_line(tmp_path: Path):
    run = make_run(tmp_path / "run")
    (run.checkpoint(ENV_STEPS) / POLICY).unlink()
    with pytest.raises(ConfigError, match=r"has no policy\.npz.* plays it without$"):
        checkpoint_policy(run.checkpoint(ENV_STEPS))


def test_it_sees_what_the_policy_saw(tmp_path: Path):
    run = make_run(tmp_path / "run", actor_obs_size=10)
    plain = read_policy(run.checkpoint(ENV_STEPS) / POLICY)
    obs = np.random.default_rng(0).normal(size=(4, OBS_SIZE)).astype(np.float32)
    assert plain.obs_size == 10
    np.testing.assert_allclose(plain(obs), load_policy(run.root)(obs[:, :10]), atol=1e-5)


def made(**changes: object) -> PlainPolicy:
    rng = np.random.default_rng(0)
    kernels = [rng.normal(size=shape).astype(np.float32) for shape in ((OBS_SIZE, 8), (8, 3))]
    zeros, ones = np.zeros(OBS_SIZE, np.float32), np.ones(OBS_SIZE, np.float32)
    biases = [np.zeros(8, np.float32), np.zeros(3, np.float32)]
    policy = PlainPolicy(kernels, biases, zeros, ones, 10.0, "normal", ACTION_SIZE, {})
    return dataclasses.replace(policy, **changes)


def test_half_of_the_size_is_nearly_the_same(tmp_path: Path):
    policy, obs = made(), np.random.default_rng(1).normal(size=(8, OBS_SIZE))
    write_policy(tmp_path / "whole.npz", policy)
    write_policy(tmp_path / "half.npz", policy, half=True)
    np.testing.assert_array_equal(read_policy(tmp_path / "whole.npz")(obs), policy(obs))
    np.testing.assert_allclose(read_policy(tmp_path / "half.npz")(obs), policy(obs), atol=1e-2)


@pytest.mark.parametrize(
    "change",
    [
        {"head": "beta"},
        {"kernels": [], "biases": []},
        {"action_size": 4},
        {"obs_std": np.ones(3, np.float32)},
        {"biases": [np.zeros(7, np.float32), np.zeros(3, np.float32)]},
        {"norms": [(np.ones(8, np.float32), np.zeros(7, np.float32))]},
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, change: dict[str, object]):
    write_policy(tmp_path / POLICY, made(**change))
    with pytest.raises(ConfigError, match="not a policy"):
        read_policy(tmp_path / POLICY)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"x" * 99])
def test_what_is_no_file_of_ours_is_refused(tmp_path: Path, content: bytes):
    path = tmp_path / POLICY
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"policy\.npz: not a policy"):
        read_policy(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_policy(tmp_path / "none.npz")

"""Policies that come with gmijax: found, refused, played without jax, and shown by the demo."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from gmijax import demo
from gmijax.__main__ import main
from gmijax.config import EnvConfig
from gmijax.config.schema import to_dict
from gmijax.control.job import Result
from gmijax.deploy import shipped as shipping
from gmijax.errors import ConfigError, GmijaxError
from gmijax.player import shipped
from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.policy import PlainPolicy, write_policy
from gmijax.runs.folder import PlayPaths, RunPaths, read_json, write_json
from gmijax.sim.trajectory import load_trajectory
from gmijax.workers import plain_playback

TASK = EnvConfig(name="ball_balance", episode_length=30)


def idle_policy(**about: Any) -> PlainPolicy:
    """It does nothing, whatever it sees."""
    kernels, biases = [np.zeros((24, 3), np.float32)], [np.zeros(3, np.float32)]
    zeros, ones = np.zeros(24, np.float32), np.ones(24, np.float32)
    about = {"env": to_dict(TASK), "env_steps": 1000, **about}
    return PlainPolicy(kernels, biases, zeros, ones, None, "normal", 3, about)


@pytest.fixture
def policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of the shipped one, with a policy of ball_balance."""
    folder = tmp_path / "policies"
    folder.mkdir()
    write_policy(folder / "ball_balance.npz", idle_policy())
    monkeypatch.setattr(shipped, "POLICIES", folder)
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["env=ant"], "env=ant: no policy of it is shipped; allowed: ball_balance"),
        ([], "checkpoint=shipped: of which task? Add env=TASK; there are ball_balance"),
        (
            ["env=ball_balance", "deterministic=false"],
            "with deterministic; remove deterministic=false",
        ),
        (
            ["env=ball_balance", "randomize=on"],
            "checkpoint=shipped cannot be combined with randomize",
        ),
        (["env=ball_balance", "physics.impl=warp"], "physics.impl; remove physics.impl=warp"),
        (
            ["run.dir=last"],
            "checkpoint=shipped cannot be combined with run.dir; remove run.dir=last",
        ),
        (["env=ball_balance", "run.dir=x"], "with run.dir; remove run.dir=x"),
    ],
)
def test_what_cannot_be_played_is_one_line(
    policies: Path, changes: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["play", "checkpoint=shipped", *changes]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (policies.parent / "runs").exists()


def test_a_task_is_named_for_shipped_policies_only(
    policies: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["play", "env=ball_balance"]) == 2
    assert "add checkpoint=shipped" in capsys.readouterr().err


def test_a_shipped_policy_is_played_as_a_checkpoint_is(policies: Path):
    config = demo.play_config("ball_balance")
    paths = shipping.folder_of(shipping.checked(config))
    assert paths.root == policies.parent / "runs" / "shipped" / "ball_balance"
    assert plain_playback.main([str(paths.root)]) == 0
    returns, trajectory = read_json(paths.returns), load_trajectory(paths.trajectory)
    assert len(returns["episodes"]) == returns["num_envs"] == 16
    assert returns["num_truncated"] + returns["num_terminated"] == 16
    assert returns["length"]["max"] <= 30
    assert returns["return"]["mean"] == pytest.approx(returns["terms"]["balance"]["mean"])
    assert trajectory.qpos.shape[1:] == (4, 20)
    assert trajectory.lines[-1] == "$ gmijax play env=ball_balance checkpoint=shipped"
    model = mujoco.MjModel.from_binary_path(str(paths.model))
    assert model.nq == 20
    # Another call leaves nothing of this one.
    assert not any(path.exists() for path in shipping.folder_of(config).results())


def test_playing_that_fails_names_its_log_from_the_working_directory(
    policies: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shipping, "run_child", lambda *_: 1)
    paths = shipping.folder_of(demo.play_config("ball_balance"))
    with pytest.raises(GmijaxError, match=r"\(log: runs/shipped/ball_balance/stderr\.log\)$"):
        shipping.play(paths)


def test_without_time_only_as_many_are_played_as_are_filmed(policies: Path):
    paths = shipping.folder_of(demo.play_config("ball_balance"))
    assert plain_playback.main([str(paths.root), "0"]) == 0
    assert read_json(paths.returns)["num_envs"] == 4


def test_an_unknown_camera_is_one_line(policies: Path, capsys: pytest.CaptureFixture[str]):
    paths = shipping.folder_of(demo.play_config("ball_balance"))
    config = to_dict(demo.play_config("ball_balance"))
    write_json(RunPaths(paths.root).config, {**config, "camera": "x"})
    assert plain_playback.main([str(paths.root)]) == 2
    assert capsys.readouterr().err.startswith("camera=x: unknown camera of ball_balance; allowed")


def test_commands_are_in_the_policy_and_can_be_set():
    env = PlainEnv(EnvConfig(name="anymal", episode_length=None))
    assert env.command_limits == {
        "forward_m_per_s": 2.0,
        "left_m_per_s": 1.0,
        "yaw_rad_per_s": 1.0,
    }
    env.command = (1.0, 0.0, -0.5)
    seen = env.step(np.zeros(12)).obs[9:12]
    np.testing.assert_allclose(seen, [2.0, 0.0, -0.125], atol=1e-6)
    with pytest.raises(ValueError, match="shape"):
        env.command = (1.0,)
    assert PlainEnv(TASK).command is None


def test_a_push_moves_the_environment_until_it_is_taken_back():
    still, pushed = PlainEnv(TASK, seed=3), PlainEnv(TASK, seed=3)
    ball = pushed.model.body("ball").id
    pushed.data.xfrc_applied[ball, 1] = 5.0
    for env in (still, pushed):
        env.step(np.zeros(3))
    assert pushed.qpos[14] > still.qpos[14]
    pushed.reset()
    assert not pushed.data.xfrc_applied.any()


def test_an_environment_that_diverges_ends_with_reward_0():
    env = PlainEnv(TASK)
    env.data.xfrc_applied[:] = 1e12
    for _ in range(5):
        step = env.step(np.zeros(3))
        if step.terminated:
            break
    assert (step.terminated, env.diverged, step.reward) == (True, True, 0.0)
    assert np.isfinite(step.obs).all()


def test_episodes_of_a_seed_are_repeated():
    env = PlainEnv(TASK, seed=5)
    first, second = env.obs, env.reset()
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(env.reset(seed=5), first)


def test_history_and_repeated_actions_are_those_of_the_run():
    config = EnvConfig(name="ball_balance", episode_length=30, history=3, action_repeat=2)
    env = PlainEnv(config)
    assert env.obs.shape == (72,)
    newest = env.obs[-24:]
    np.testing.assert_array_equal(env.step(np.zeros(3)).obs[24:48], newest)
    steps = 1
    while not (last := env.step(np.zeros(3))).truncated and not last.terminated:
        steps += 1
    assert steps < 15 or last.truncated


@pytest.mark.parametrize("suite", ["brax", "custom"])
def test_tasks_of_others_are_not_played_without_jax(suite: Any):
    config = EnvConfig(suite=suite, name="x.py:make", episode_length=None)
    with pytest.raises(ConfigError, match=r"only our own tasks .*; gmijax play films others"):
        PlainEnv(config)


def test_a_policy_says_its_task():
    assert task_of(idle_policy()) == TASK
    with pytest.raises(ConfigError, match="of which task"):
        task_of(idle_policy(env=None))


@pytest.fixture
def shown(policies: Path, monkeypatch: pytest.MonkeyPatch) -> list[float | None]:
    """Seconds of the films that the demo asks for; it plays in this process."""
    films: list[float | None] = []

    def play(paths: PlayPaths, seconds: float | None = None) -> None:
        plain_playback.main([str(paths.root), str(seconds)])

    monkeypatch.setattr(shipping, "play", play)
    monkeypatch.setattr(demo, "film", lambda *given: films.append(given[-1]))
    return films


def test_the_demo_plays_and_says_what_it_is(
    shown: list[float | None], capsys: pytest.CaptureFixture[str]
):
    assert main(["demo"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("ball_balance: a policy that gmijax trained for 1,000 env steps\n")
    assert "episodes in MuJoCo: return " in output
    assert re.search(r"  gmijax (play|view) env=ball_balance checkpoint=shipped\n", output)
    assert output.endswith("Next: train ball_balance yourself\n  gmijax train env=ball_balance\n")
    trajectory = load_trajectory(Path("runs/shipped/ball_balance/trajectory.npz"))
    assert trajectory.lines[-1] == "$ gmijax demo env=ball_balance"
    assert shown == [demo.FILM_S]
    assert not list(Path.cwd().glob("runs/shipped/*/model.mjb"))


def test_the_demo_of_a_task_without_a_policy_is_one_line(
    shown: list[float | None], capsys: pytest.CaptureFixture[str]
):
    assert main(["demo", "env=ant"]) == 2
    assert "env=ant: no policy of it is shipped" in capsys.readouterr().err
    assert shown == []


@pytest.mark.parametrize(("answer", "trains"), [("y\n", True), ("\n", False), ("", False)])
def test_at_a_terminal_the_demo_asks_before_it_trains(
    shown: list[float | None], monkeypatch: pytest.MonkeyPatch, answer: str, trains: bool
):
    trained: list[Any] = []
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    for stream in ("sys.stdin", "sys.stdout"):
        monkeypatch.setattr(f"{stream}.isatty", lambda: True, raising=False)

    def train(config: Any, *, show: bool) -> Result:
        trained.append(config)
        return Result(Path.cwd(), {})

    monkeypatch.setattr("gmijax.control.job.train", train)
    monkeypatch.setattr("gmijax.deploy.playing.play", lambda config, *, show: None)
    assert main(["demo"]) == 0
    assert [config.env.name for config in trained] == ["ball_balance"] * trains

"""The loop of the viewer without a browser: time, and what is asked of it."""

from __future__ import annotations

import queue
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plain_run import add_checkpoint, constant_policy, make_plain_run

from gmijax.cli.compose import compose
from gmijax.player.plain_env import PlainEnv
from gmijax.runs.folder import META
from gmijax.viewer import checkpoints, requests
from gmijax.viewer.checkpoints import Checkpoints
from gmijax.viewer.loop import IDLE_S, Loop, View
from gmijax.viewer.simulation import Simulation


class Paper:
    """Notes what is drawn."""

    def __init__(self) -> None:
        self.pictures, self.texts, self.clients = 0, 0, 1
        self.view: View | None = None

    def num_clients(self) -> int:
        return self.clients

    def draw(self, simulation: Simulation, view: View) -> None:
        self.pictures += 1

    def write(self, simulation: Simulation, view: View) -> None:
        self.texts, self.view = self.texts + 1, view


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Stand:
    """A loop whose time the test moves on."""

    def __init__(self, task: str = "ball_balance", num_envs: int = 2, **about: Any) -> None:
        envs = [PlainEnv(compose(f"env={task}").env, seed=number) for number in range(num_envs)]
        self.simulation = Simulation(envs, constant_policy(envs[0], 0.0), seed=0)
        self.paper, self.clock = Paper(), Clock()
        asked: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.loop = Loop(self.simulation, self.paper, asked, clock=self.clock, **about)

    def pass_s(self, seconds: float, turn_s: float = 0.001) -> None:
        for _ in range(round(seconds / turn_s)):
            self.clock.now += turn_s
            self.loop.turn()

    @property
    def steps(self) -> int:
        return self.simulation.steps

    def qvel(self, env: int = 0) -> Any:
        return self.simulation.envs[env].data.qvel.copy()


def test_it_runs_in_real_time_with_50_pictures_a_second() -> None:
    stand = Stand()
    stand.pass_s(1.2)
    assert stand.steps == pytest.approx(1.2 / stand.simulation.control_dt_s, abs=2)
    assert stand.paper.pictures == pytest.approx(60, abs=2)
    assert stand.paper.texts == pytest.approx(6, abs=1)
    assert stand.paper.view is not None
    assert stand.paper.view.rate == pytest.approx(1.0, abs=0.05)
    assert not stand.paper.view.is_late


def test_its_speed_can_be_set() -> None:
    stand = Stand()
    stand.loop.do(requests.SetSpeed(0.25))
    stand.pass_s(1.0)
    assert stand.steps == pytest.approx(0.25 / stand.simulation.control_dt_s, abs=2)


def test_a_slow_machine_drops_what_it_missed_and_says_so() -> None:
    stand = Stand()
    stand.pass_s(3.0, turn_s=0.15)
    assert stand.steps == pytest.approx(20, abs=1)
    assert stand.paper.view is not None
    assert stand.paper.view.is_late
    assert stand.paper.view.rate < 0.2


def test_pause_stops_a_step_is_one_and_going_on_does_not_hurry() -> None:
    stand = Stand()
    stand.loop.do(requests.Pause(True))
    stand.pass_s(1.0)
    assert stand.steps == 0
    stand.loop.do(requests.StepRequest())
    stand.loop.do(requests.StepRequest())
    assert stand.steps == 2
    assert stand.loop.view.paused
    stand.loop.do(requests.Pause(False))
    stand.pass_s(0.1)
    assert 2 < stand.steps <= 2 + 0.1 / stand.simulation.control_dt_s + 1


def test_reset_begins_new_episodes() -> None:
    stand = Stand()
    stand.pass_s(0.1)
    first = stand.simulation.episodes[0]
    stand.loop.do(requests.Reset())
    assert stand.simulation.episodes[0].steps == 0
    assert stand.simulation.episodes[0].number == 2
    assert stand.simulation.episodes[0].last_return == pytest.approx(sum(first.sums.values()))


def test_a_push_moves_the_selected_robot_alone() -> None:
    pushed, left_alone = Stand("anymal"), Stand("anymal")
    pushed.loop.do(requests.Select(1))
    pushed.loop.do(requests.Push(1.0))
    for stand in (pushed, left_alone):
        stand.simulation.step()
    change = pushed.qvel(1)[:2] - left_alone.qvel(1)[:2]
    assert np.linalg.norm(change) == pytest.approx(1.0, abs=0.4)
    np.testing.assert_array_equal(pushed.qvel(0), left_alone.qvel(0))
    assert list(pushed.simulation.pushed_lately()) == [1]
    # It is over after that step.
    assert not pushed.simulation.envs[1].data.xfrc_applied.any()


@pytest.mark.parametrize("task", ["ant", "ball_balance"])
def test_a_body_that_is_pulled_right_after_a_reset_stays_whole(task: str) -> None:
    stand = Stand(task, num_envs=1)
    stand.loop.do(requests.Reset())
    body = stand.simulation.pushed
    at = stand.simulation.poses()[0][0, body]
    stand.loop.do(requests.Drag(0, body, at, at + np.array([0.0, 0.0, 0.3])))
    stand.loop.do(requests.StepRequest())
    assert stand.simulation.episodes[0].steps == 1
    assert np.abs(stand.qvel()).max() < 50.0


def test_a_pull_ends_with_its_episode_until_the_mouse_lets_go() -> None:
    stand, alone = Stand("ant", num_envs=1), Stand("ant", num_envs=1)
    body = stand.simulation.pushed
    at = stand.simulation.poses()[0][0, body]
    far = requests.Drag(0, body, at, at + 5.0)
    for asked in (far, requests.Reset(), far):  # Of one movement of the mouse.
        stand.loop.do(asked)
    alone.loop.do(requests.Reset())
    for one in (stand, alone):
        one.loop.do(requests.StepRequest())
    np.testing.assert_array_equal(stand.qvel(), alone.qvel())


def test_a_checkpoint_under_another_name_is_called_by_it() -> None:
    assert checkpoints.label(Path("runs/a/checkpoints/mine")) == "mine"
    assert checkpoints.label(Path("runs/a/checkpoints/000000001000")) == "1,000 steps"


def test_the_mouse_pulls_a_body_until_it_lets_go() -> None:
    stand = Stand("anymal", num_envs=1)
    base = stand.simulation.model.body("base").id
    stand.simulation.step()
    at = stand.simulation.envs[0].data.xpos[base].copy()
    above = at + np.array([0.0, 0.0, 2.0])
    for _ in range(25):
        stand.loop.do(requests.Drag(0, base, at, above))
        stand.simulation.step()
    assert stand.simulation.envs[0].data.xpos[base][2] > at[2] + 0.3
    stand.loop.do(requests.Drag(0, base, at, None))
    falling = stand.qvel()[2]
    stand.simulation.step()
    assert stand.qvel()[2] < falling


def test_a_command_holds_for_all_until_it_is_drawn_again() -> None:
    stand = Stand("anymal")
    stand.loop.do(requests.SetCommand((1.0, 0.0, -0.5)))
    stand.loop.do(requests.Reset())
    for env in stand.simulation.envs:
        np.testing.assert_allclose(np.asarray(env.command), (1.0, 0.0, -0.5))
    stand.loop.do(requests.SetCommand(None))
    stand.loop.do(requests.Reset())
    assert not np.allclose(stand.simulation.envs[0].command, (1.0, 0.0, -0.5))


def test_terms_are_counted_of_every_environment() -> None:
    stand = Stand()
    for _ in range(3):
        stand.simulation.step()
    for episode in stand.simulation.episodes:
        assert episode.steps == 3
        assert episode.sums.keys() == episode.now.keys() == {"balance"}
        assert episode.sums["balance"] > episode.now["balance"] > 0.0


def test_an_episode_that_ends_is_followed_by_another() -> None:
    stand = Stand(num_envs=1)
    for _ in range(600):  # The ball rolls off, or time runs out.
        stand.simulation.step()
    episode = stand.simulation.episodes[0]
    assert episode.number > 1
    assert episode.last_return is not None


def test_nothing_is_simulated_for_nobody() -> None:
    stand = Stand()
    stand.paper.clients = 0
    stand.pass_s(IDLE_S + 1.0, turn_s=0.05)
    assert stand.loop.is_idle
    steps, pictures = stand.steps, stand.paper.pictures
    stand.pass_s(5.0, turn_s=0.05)
    assert (stand.steps, stand.paper.pictures) == (steps, pictures)
    stand.paper.clients = 1
    stand.loop.do(requests.Wake())
    stand.pass_s(0.1)
    assert stand.steps > steps


def action_of(stand: Stand) -> float:
    """The action in every state."""
    obs = np.zeros((1, stand.simulation.envs[0].spec.obs_size))
    return float(np.asarray(stand.simulation.policy(obs))[0, 0])


def following(root: Path, *env_steps: int) -> tuple[Any, Stand]:
    run = make_plain_run(root, *env_steps)
    stand = Stand(
        run=Checkpoints(run.root),
        checkpoint=run.checkpoint(env_steps[-1]),
        follow_training=True,
    )
    return run, stand


def test_new_checkpoints_of_a_training_are_taken(tmp_path: Path) -> None:
    run, stand = following(tmp_path / "run", 100)
    stand.pass_s(0.01)
    add_checkpoint(run, 200)
    stand.pass_s(3.0, turn_s=0.05)
    assert stand.loop.view.checkpoint == run.checkpoint(200)
    assert stand.loop.view.checkpoint_age_s is not None
    assert action_of(stand) == pytest.approx(0.2)


def test_a_checkpoint_that_is_chosen_stays(tmp_path: Path) -> None:
    run, stand = following(tmp_path / "run", 100, 200)
    stand.loop.do(requests.UseCheckpoint(run.checkpoint(100)))
    add_checkpoint(run, 300)
    stand.pass_s(3.0, turn_s=0.05)
    assert action_of(stand) == pytest.approx(0.1)
    assert stand.loop.view.checkpoints == tuple(map(run.checkpoint, (100, 200, 300)))
    stand.loop.do(requests.FollowTraining(True))
    assert action_of(stand) == pytest.approx(0.3)


def test_a_damaged_checkpoint_is_not_taken(tmp_path: Path) -> None:
    run, stand = following(tmp_path / "run", 100)
    add_checkpoint(run, 200)
    (run.checkpoint(200) / META).write_text("{")
    stand.pass_s(2.5, turn_s=0.05)
    assert stand.loop.view.checkpoint == run.checkpoint(100)
    assert stand.loop.view.problem == "200 steps: gone, damaged, or no policy"
    assert action_of(stand) == pytest.approx(0.0)  # As the simulation began.


def test_a_checkpoint_may_vanish_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, stand = following(tmp_path / "run", 100)
    stand.pass_s(0.01)
    add_checkpoint(run, 200)
    real = checkpoints.read

    def late(checkpoint: Path) -> Any:
        shutil.rmtree(checkpoint)
        return real(checkpoint)

    monkeypatch.setattr(checkpoints, "read", late)
    stand.pass_s(2.5, turn_s=0.05)
    assert "200 steps: gone" in stand.loop.view.problem
    assert stand.loop.view.checkpoint == run.checkpoint(100)
    monkeypatch.setattr(checkpoints, "read", real)
    add_checkpoint(run, 300)
    shutil.rmtree(run.checkpoint(100))
    stand.pass_s(2.5, turn_s=0.05)
    assert stand.loop.view.checkpoint == run.checkpoint(300)
    assert stand.loop.view.problem == ""
    shutil.rmtree(run.root)
    stand.pass_s(5.0, turn_s=0.05)  # Goes on with what it has.
    assert action_of(stand) == pytest.approx(0.3)
    assert stand.loop.view.checkpoint_age_s is None

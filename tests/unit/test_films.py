"""Films of evaluations: which are made, by what, and what happens where they cannot be."""

from __future__ import annotations

import dataclasses
import subprocess
import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from toy_env import point_mass_env

from gmijax.cli.compose import compose
from gmijax.config import TrainConfig
from gmijax.control.films import filmed, find_opengl
from gmijax.errors import ConfigError
from gmijax.learning.episode_films import EpisodeFilms
from gmijax.learning.episodes import Episodes
from gmijax.machine import opengl
from gmijax.runs.folder import EXIT_NO_GL, RunPaths
from gmijax.sim.interface import Env
from gmijax.sim.trajectory import load_trajectory
from gmijax.workers import film_writer


def config_of(*overrides: str) -> TrainConfig:
    return compose("eval.every=100", "num_timesteps=1000", *overrides)


def env_with_model() -> Env:
    return point_mass_env()._replace(mj_model=mujoco.MjModel.from_xml_string("<mujoco/>"))


def episodes(height: float = 0.0) -> Episodes:
    nothing = dict.fromkeys(Episodes._fields)
    qpos, lengths = np.full((3, 1, 1), height, np.float32), np.array([2, 1], np.int32)
    returns = np.array([7.0, 5.0], np.float32)
    return Episodes(**nothing | {"qpos": qpos, "lengths": lengths, "returns": returns})


@pytest.fixture
def works(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of OpenGLs that work; any other is missing."""
    found: set[str] = set()

    def run(command: Any, *, env: dict[str, str], **_: Any) -> subprocess.CompletedProcess[str]:
        gl = env["MUJOCO_GL"]
        exit_code = 0 if gl in found else EXIT_NO_GL
        return subprocess.CompletedProcess(command, exit_code, "", f"ImportError: no {gl}\nmore\n")

    monkeypatch.setattr(opengl.subprocess, "run", run)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    return found


def test_films_are_drawn_on_the_cpu_if_they_can_be(
    works: set[str], monkeypatch: pytest.MonkeyPatch
):
    config = config_of("eval.video=true")
    works.add("egl")
    assert find_opengl(config) == "egl"
    works.add("osmesa")
    assert find_opengl(config) == "osmesa"
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert find_opengl(config) == "egl"


def test_without_opengl_training_with_films_is_bad_input(works: set[str]):
    assert find_opengl(config_of()) is None
    with pytest.raises(
        ConfigError, match=r"=3: no headless .* no egl; without it, use eval.video=false$"
    ) as caught:
        find_opengl(config_of("eval.video=3"))
    assert "\n" not in str(caught.value)


def test_films_need_evaluations():
    with pytest.raises(ConfigError, match=r"^eval\.video=True: .* give eval.every"):
        compose("eval.video=true")
    with pytest.raises(ConfigError, match=r"^eval\.video=-1: must be at least 0$"):
        config_of("eval.video=-1")
    with pytest.raises(ConfigError, match=r"^eval\.video=often: expected true or false or an int"):
        config_of("eval.video=often")


def test_films_need_a_model(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"^eval\.video=True: point_mass has no model"):
        EpisodeFilms(config_of("eval.video=true"), point_mass_env(), RunPaths(tmp_path))


@pytest.mark.parametrize(
    ("video", "filmed_steps"),
    [("true", [128, 256, 320, 1024]), ("2", [256, 448, 960, 1024]), ("9", [960, 1024])],
)
def test_every_nth_evaluation_is_filmed_and_the_last(
    tmp_path: Path, video: str, filmed_steps: list[int]
):
    run = RunPaths(tmp_path)
    config = dataclasses.replace(config_of(f"eval.video={video}"), num_timesteps=1024)
    films = EpisodeFilms(config, env_with_model(), run)
    evaluated = [128, 256, 320, 448, 960, 1024] if video != "true" else filmed_steps
    for env_steps in evaluated:
        films.take(env_steps, episodes(env_steps))
    left = sorted(run.videos.glob("*.npz"))
    assert left == [run.to_film(steps) for steps in filmed_steps]
    trajectory = load_trajectory(left[-1])
    assert (trajectory.qpos == 1024).all()
    assert trajectory.lengths.tolist() == [2]
    assert trajectory.labels == ("return 7 (rank 1 of 1)",)
    assert trajectory.control_dt_s == pytest.approx(0.1)
    assert mujoco.MjModel.from_binary_path(str(run.filmed_model)).nq == 0


def test_the_newest_of_those_that_wait_is_filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run, over, made = RunPaths(tmp_path), threading.Event(), []
    films = EpisodeFilms(config_of("eval.video=true"), env_with_model(), run)
    for env_steps in (100, 200, 300):
        films.take(env_steps, episodes())

    def film(paths: tuple[Path, ...], *_: Any) -> None:
        made.extend(paths)
        if len(made) == 1:
            films.take(400, episodes())
            over.set()  # The job ends while a film is made and another one waits.

    monkeypatch.setattr(film_writer, "film", film)
    monkeypatch.setattr(film_writer, "Stage", lambda *_: object())
    run.video(50).with_name(".000000000050.mp4").touch()
    film_writer.follow(run, over)
    assert made == [run.video(300), run.video(400)]
    assert list(run.videos.iterdir()) == [run.filmed_model]


def test_a_job_that_fails_does_not_wait_for_films(tmp_path: Path):
    messages: list[str] = []
    run = RunPaths(tmp_path)
    EpisodeFilms(config_of("eval.video=true"), env_with_model(), run)
    with pytest.raises(RuntimeError), filmed("egl", run, messages.append):
        raise RuntimeError
    assert (messages, run.film_log.exists()) == ([], False)
    assert list(run.videos.iterdir()) == []


@pytest.mark.parametrize(("is_well", "waited"), [(True, "120 s"), (False, "5 s")])
def test_a_film_that_is_given_up_is_named_with_the_seconds_of_the_wait(
    is_well: bool, waited: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    messages: list[str] = []
    process = SimpleNamespace(send=lambda _: None, end=lambda _: False)
    monkeypatch.setattr("gmijax.control.films.SideProcess", lambda *_, **__: process)
    with (
        nullcontext() if is_well else pytest.raises(RuntimeError),
        filmed("egl", RunPaths(tmp_path), messages.append),
    ):
        if not is_well:
            raise RuntimeError
    assert messages == [f"eval.video: the last film was given up after {waited}"]


def test_what_cannot_be_drawn_is_one_line_and_no_error(tmp_path: Path):
    messages: list[str] = []
    run = RunPaths(tmp_path)
    films = EpisodeFilms(config_of("eval.video=true"), env_with_model(), run)
    films.take(100, episodes())
    run.filmed_model.write_bytes(b"no model")
    with filmed("no-such-gl", run, messages.append):
        pass
    (line,) = (line for line in messages if line != "filming the last evaluation")
    assert line.startswith("eval.video: no more films are made: ")
    assert run.to_film(100).exists()

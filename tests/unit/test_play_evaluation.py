"""What the controller of `play` decides before and after its children run."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from supervision import save_meta

from gmijax.cli.command import command
from gmijax.cli.compose import compose
from gmijax.config import EnvConfig, PlayConfig
from gmijax.config.schema import to_dict
from gmijax.deploy import pictures, playing, trained_run
from gmijax.deploy.trained_run import checkpoint_of, open_run
from gmijax.errors import ConfigError, GmijaxError
from gmijax.learning.walking import walking_env
from gmijax.machine.nvidia import Gpu
from gmijax.machine.snapshot import Machine
from gmijax.player.joystick import ROBOTS
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import EXIT_NO_GL, META, PlayPaths, RunPaths, write_json
from gmijax.runs.held import locked
from gmijax.supervise.start_gmi import environment_of


def config_of(*overrides: str) -> PlayConfig:
    found: list[PlayConfig] = []
    assert command("play", PlayConfig, lambda c, **_: found.append(c), overrides) == 0
    return found[0]


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    """A run folder with two checkpoints that hold nothing."""
    paths = RunPaths(tmp_path / "runs" / "x")
    paths.root.mkdir(parents=True)
    write_json(paths.config, {})
    for env_steps in (100, 2000):
        meta = CheckpointMeta("ant", "ppo", env_steps, 1, 4, ((8,), (8,)), "jax")
        save_meta(paths, meta)
    return paths


def test_the_latest_checkpoint_is_played_unless_one_is_named(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(run.root.parents[1])
    first, latest, best = (run.checkpoint(steps) for steps in (100, 2000, 300))
    meta = CheckpointMeta.read(latest)
    write_json(latest / META, dataclasses.replace(meta, eval_return=-2.0).to_dict())
    meta = dataclasses.replace(meta, env_steps=300, eval_return=-1.0)
    write_json(best / META, meta.to_dict())
    for overrides, expected in (
        ((), latest),
        (("run.dir=last",), latest),
        ((f"run.dir={run.root}",), latest),
        ((f"run.dir={run.root}", "checkpoint=100"), first),
        ((f"checkpoint={first}",), first),
        ((f"run.dir={run.root}", f"checkpoint={first}"), first),
        ((f"run.dir={run.root}", "checkpoint=best"), best),
        (("checkpoint=best",), best),
    ):
        assert checkpoint_of(config_of(*overrides)) == (expected, ())


def test_a_best_checkpoint_that_is_damaged_is_named(run: RunPaths):
    """Also one whose rank cannot be read any more."""
    named = f"run.dir={run.root}", "checkpoint=best"
    meta = dataclasses.replace(CheckpointMeta.read(run.checkpoint(100)), eval_return=-3.0)
    damaged = {"files": {"learner": (1, 2)}}
    for env_steps, more in ((100, {}), (200, {}), (300, {"eval_return": -1.0} | damaged)):
        save_meta(run, dataclasses.replace(meta, env_steps=env_steps, **more))
    (run.checkpoint(200) / META).write_text("{")
    (run.checkpoint(2000) / META).write_text("{")
    checkpoint, passed_over = checkpoint_of(config_of(*named))
    assert checkpoint == run.checkpoint(100)
    starts = [line.partition(": passed over, ")[0][-12:] for line in passed_over]
    assert sorted(starts) == [f"{steps:012d}" for steps in (200, 300, 2000)]


@pytest.mark.parametrize(
    ("compared", "is_noted"),
    [({}, True), ({"eval_return": -1.0}, False), ({"window_full": True}, False)],
)
def test_a_best_checkpoint_that_nothing_was_compared_by_is_noted(
    compared: dict[str, Any], is_noted: bool, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    env = EnvConfig(name="ant", episode_length=None)
    monkeypatch.setattr(trained_run, "trained_config", lambda checkpoint: (env, None))
    monkeypatch.setattr(trained_run, "left_out", lambda checkpoint: None)
    first = run.checkpoint(100)
    meta = dataclasses.replace(CheckpointMeta.read(first), mean_return=-6.3, **compared)
    write_json(first / META, meta.to_dict())
    for wanted in ("best", str(first)):
        config, _, changed = open_run(config_of(f"run.dir={run.root}", f"checkpoint={wanted}"))
        assert config.checkpoint == str(first.resolve())
        assert (changed is not None) == (is_noted and wanted == "best")


def test_a_checkpoint_outside_of_its_run_is_bad_input(run: RunPaths, tmp_path: Path):
    copied = tmp_path / "elsewhere" / "copied"
    shutil.copytree(run.checkpoint(100), copied)
    with pytest.raises(
        ConfigError, match=r"no config\.json .* can only be used in its run folder"
    ):
        playing.play(config_of(f"checkpoint={copied}"))
    assert list(copied.parent.iterdir()) == [copied]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("run.dir=last",), "run.dir=last: no run with a checkpoint in runs/"),
        (("run.dir={other}", "checkpoint={run}/checkpoints/000000000100"), "not of run.dir="),
        (("run.dir={run}", "checkpoint=7"), "checkpoint=7: no such checkpoint.*are 100, 2000"),
        (("checkpoint=nowhere",), "checkpoint=nowhere: expected the folder of a checkpoint"),
    ],
)
def test_a_checkpoint_that_cannot_be_meant_is_bad_input(
    run: RunPaths,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    overrides: tuple[str, ...],
    message: str,
):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    other = shutil.copytree(run.root, tmp_path / "runs" / "y")
    config = config_of(*(text.format(run=run.root, other=other) for text in overrides))
    with pytest.raises(ConfigError, match=message):
        checkpoint_of(config)


def test_the_last_run_is_not_mistaken_for_one_that_is_training(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    new = RunPaths(run.root.parent / "new")
    new.root.mkdir()
    for paths in (run, new):
        write_json(paths.config, to_dict(compose("env=ant")))
    monkeypatch.chdir(run.root.parents[1])
    with locked(new.lock, "new"):
        assert "runs/new: still training, no checkpoint yet" in str(open_run(config_of())[2])
        assert open_run(config_of(f"run.dir={run.root}"))[2] is None
    assert open_run(config_of())[2] is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("randomize=on", "names nothing to draw"),
        ("walking_envs=8", "walking_envs=8: ant has no walking test"),
    ],
)
def test_what_the_task_does_not_have_is_refused(
    override: str, message: str, run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    env = EnvConfig(name="ant", episode_length=None)
    monkeypatch.setattr(trained_run, "trained_config", lambda checkpoint: (env, None))
    monkeypatch.setattr(trained_run, "left_out", lambda checkpoint: None)
    with pytest.raises(ConfigError, match=message):
        playing.play(config_of(f"run.dir={run.root}", override))


def test_a_robot_that_repeats_actions_has_no_walking_test(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    env = EnvConfig(suite="playground", name="go1", episode_length=None, action_repeat=2)
    monkeypatch.setattr(trained_run, "trained_config", lambda checkpoint: (env, None))
    monkeypatch.setattr(trained_run, "left_out", lambda checkpoint: None)
    monkeypatch.setattr(trained_run, "require_env", lambda env: None)
    monkeypatch.setattr(playing, "trained_config", lambda checkpoint: (env, None))
    message = "env.action_repeat=2; the walking test takes 1 only"
    with pytest.raises(ConfigError, match=f"^walking_envs=8: {message}$"):
        playing.play(config_of(f"run.dir={run.root}", "walking_envs=8"))
    assert (
        playing.walking_lines(config_of(f"run.dir={run.root}"), None)
        == f"no walking test: {message}"
    )
    with pytest.raises(ConfigError, match=r"^env.action_repeat=2: the walking test takes 1 only$"):
        walking_env(env, ROBOTS["go1"], "jax", 4)


def test_a_robot_without_randomisation_cannot_be_played_with_one(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    env = EnvConfig(suite="playground", name="spot", episode_length=None)
    monkeypatch.setattr(trained_run, "trained_config", lambda checkpoint: (env, None))
    monkeypatch.setattr(trained_run, "left_out", lambda checkpoint: None)
    monkeypatch.setattr(trained_run, "require_env", lambda env: None)
    with pytest.raises(ConfigError, match="Playground has no randomisation for spot"):
        playing.play(config_of(f"run.dir={run.root}", "randomize=on"))


def test_without_a_walking_test_the_reason_is_named(monkeypatch: pytest.MonkeyPatch):
    env = EnvConfig(suite="playground", name="go1", episode_length=None)
    monkeypatch.setattr(playing, "trained_config", lambda checkpoint: (env, None))
    assert "walking_envs=8" in playing.walking_lines(config_of(), None)
    assert "walking_envs=0" in playing.walking_lines(config_of("walking_envs=0"), None)


def test_playing_leaves_a_gpu_to_the_job_that_trains_on_it(run: RunPaths):
    machine = Machine(gpus=(Gpu(0, "GPU-1", "some GPU", 80000, (9, 0), False),), cpu_cores=(0, 1))
    config = config_of(f"run.dir={run.root}", "num_envs=4", "video_envs=1")
    launch = playing.launch_of(config, PlayPaths(run.root), machine)
    environment = environment_of(launch, 0, {})
    assert environment["XLA_CLIENT_MEM_FRACTION"] == "0.1"
    assert environment["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"


@pytest.fixture
def quiet() -> Console:
    return Console(quiet=True)


def test_every_opengl_is_tried_the_users_first(
    tmp_path: Path, quiet: Console, monkeypatch: pytest.MonkeyPatch
):
    tried: list[str] = []
    monkeypatch.setenv("MUJOCO_GL", "glfw")

    def render(gl: str, *_: Any) -> int:
        tried.append(gl)
        # -11: a driver that crashes is no reason to give up either.
        return {"glfw": EXIT_NO_GL, "egl": -11, "osmesa": 0}[gl]

    monkeypatch.setattr(pictures, "render", render)
    pictures.film(config_of(), PlayPaths(tmp_path), "camera track", quiet)
    assert tried == ["glfw", "egl", "osmesa"]


@pytest.mark.parametrize(
    ("exit_code", "why"),
    [
        (-9, "the renderer was ended by SIGKILL: OSError: disk full"),
        (-15, "the renderer was ended by SIGTERM"),
        (1, "OSError: disk full"),
    ],
)
def test_a_renderer_that_fails_for_another_reason_says_why(
    tmp_path: Path, quiet: Console, monkeypatch: pytest.MonkeyPatch, exit_code: int, why: str
):
    monkeypatch.chdir(tmp_path)
    paths = PlayPaths(tmp_path)
    paths.render_log.write_text("Traceback\nOSError: disk full\n")
    monkeypatch.setattr(pictures, "render", lambda *_: exit_code)
    with pytest.raises(GmijaxError, match=rf"no video: {why}.*\(log: render\.log\)"):
        pictures.film(config_of("video=auto"), paths, "camera track", quiet)


def test_a_page_that_fails_names_its_log_from_the_working_directory(
    tmp_path: Path, quiet: Console, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pictures, "missing", tuple)
    monkeypatch.setattr(pictures, "run_child", lambda *_: 1)
    with pytest.raises(GmijaxError, match=r"no page: .*\(log: page\.log\)"):
        pictures.write_page(config_of("html=on"), PlayPaths(tmp_path), quiet)


def test_without_opengl_only_a_film_that_was_asked_for_is_an_error(
    tmp_path: Path, quiet: Console, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(pictures, "render", lambda *_: EXIT_NO_GL)
    paths = PlayPaths(tmp_path)
    paths.render_log.write_text("Traceback\nImportError: no library\n")
    pictures.film(config_of("video=auto"), paths, "camera track", quiet)
    with pytest.raises(GmijaxError, match=r"egl, osmesa.*libegl1.*libosmesa6.*no library.*log: "):
        pictures.film(config_of("video=gif"), paths, "camera track", quiet)


def test_a_film_that_was_asked_for_of_a_task_without_a_model_is_an_error(quiet: Console):
    with pytest.raises(GmijaxError, match="point has no model that could be filmed; the returns"):
        playing.without_film(config_of("video=gif"), "point", quiet)


def test_a_missing_opengl_is_noticed_by_the_child(tmp_path: Path):
    pytest.importorskip("mujoco")
    write_json(RunPaths(tmp_path).config, to_dict(config_of()))
    code = pictures.render("no-such-gl", PlayPaths(tmp_path))
    assert code == EXIT_NO_GL, PlayPaths(tmp_path).render_log.read_text()

"""Only names of twelve digits are checkpoints; what else is beside them is somebody's own."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path

import pytest
from supervision import save, save_meta

from gmijax.cli.compose import build, compose
from gmijax.config import PlayConfig, TrainConfig
from gmijax.control.films import filmed
from gmijax.control.run_folder import clear_unfinished, keep_logs, opened, what_is_left
from gmijax.control.start_point import StartPoint
from gmijax.control.summary import train_outcome
from gmijax.deploy.trained_run import open_run
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.learning.checkpoint import finish_checkpoint
from gmijax.runs.checkpoints import CheckpointMeta, checkpoints_of, newest_checkpoint
from gmijax.runs.dataset import DataPaths
from gmijax.runs.folder import META, RunPaths, write_json
from gmijax.runs.names import attempt_folders, by_steps, gmi_folders, steps_name, steps_of
from gmijax.runs.ranking import best_checkpoint, best_evaluation, ranked
from gmijax.runs.resume import choose_checkpoint, last_run

COPIES = (
    "2026-11-26-good",
    "000000000100.mine",
    "000000000100 (copy)",
    "000000000900~",
    "0000000009000",
    "90000000000",
    "\u0660" * 9 + "\u0669" + "\u0660" * 2,
    "best",
    ".000000000900.bak",
)
"""Names that a user may give to a copy; none of them is twelve ASCII digits."""


@pytest.fixture
def run(tmp_path: Path) -> RunPaths:
    paths = RunPaths(tmp_path / "run")
    for env_steps in (100, 200, 300):
        save(paths, env_steps)
    for name in COPIES:
        shutil.copytree(paths.checkpoint(100), paths.checkpoints / name)
    return paths


def names(run: RunPaths) -> set[str]:
    return {path.name for path in run.checkpoints.iterdir()}


def test_copies_are_no_checkpoints(run: RunPaths):
    assert [int(path.name) for path in checkpoints_of(run.root)] == [100, 200, 300]
    assert newest_checkpoint(run.root) == (run.checkpoint(300), ())
    assert best_checkpoint(run.root) == run.checkpoint(300)
    assert best_evaluation(run.root, 10**12) == float("-inf")
    # A copy can be named itself.
    assert choose_checkpoint(str(run.checkpoints / "best"), "x")[0].name == "best"


def test_a_checkpoint_that_cannot_be_read_is_ranked_last(run: RunPaths):
    (run.checkpoint(300) / META).write_text("{")
    assert [int(path.name) for _, path in ranked(checkpoints_of(run.root))] == [200, 100, 300]


def test_a_copy_under_the_name_of_other_steps_is_passed_over(run: RunPaths):
    shutil.copytree(run.checkpoint(100), run.checkpoint(900))
    found = newest_checkpoint(run.root)
    assert found.checkpoint == run.checkpoint(300)
    assert found.passed_over[0].endswith(f"passed over, {META} is that of 000000000100")


def test_pruning_counts_and_removes_nothing_but_checkpoints(run: RunPaths):
    (run.checkpoints / ".000000000400.partial" / "learner").mkdir(parents=True)
    finish_checkpoint(run, CheckpointMeta("ant", "ppo", 400, 1, 8, ((8,), (8,)), "jax"), keep=2)
    assert names(run) == {steps_name(300), steps_name(400), *COPIES}


def test_pruning_keeps_what_was_just_written_beside_a_later_one_that_is_broken(run: RunPaths):
    (run.checkpoint(300) / META).write_text("{")
    (run.checkpoints / ".000000000250.partial" / "learner").mkdir(parents=True)
    meta = CheckpointMeta("ant", "ppo", 250, 1, 8, ((8,), (8,)), "jax", mean_return=1.0)
    finish_checkpoint(run, meta, keep=1)
    assert newest_checkpoint(run.root).checkpoint == run.checkpoint(250)


def test_a_restart_leaves_alone_what_is_not_its_own(run: RunPaths):
    ours = [run.unfinished(400), run.removed(100)]
    theirs = [run.checkpoints / name for name in (".git", ".partial", ".000000000400.partial.old")]
    for folder in (*ours, *theirs, run.gmi(0).root, run.root / "gmi_0.bak"):
        folder.mkdir()
    for gmi in (run.gmi(0).root, run.root / "gmi_0.bak"):
        (gmi / "result.json").touch()
    clear_unfinished(run, run.checkpoint(300))
    assert [path.exists() for path in ours] == [False, False]
    assert all(path.exists() for path in theirs)
    assert not run.gmi(0).result.exists()
    assert (run.root / "gmi_0.bak" / "result.json").exists()
    run.gmi(0).stderr.touch()
    keep_logs(run)
    assert attempt_folders(run.gmi(0).root) == [run.gmi(0).root / "attempt_0"]
    assert os.listdir(run.root / "gmi_0.bak") == ["result.json"]


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (("env=ant",), "env=ant algo=ppo"),
        (("env=brax", "env.name=ant"), "env=brax env.name=ant algo=ppo"),
        (("env=my tasks/cart.py:make", "algo=sac"), "env='my tasks/cart.py:make' algo=sac"),
        (("env=ant", "plan.gmis_per_gpu=2"), "env=ant algo=ppo plan.gmis_per_gpu=2"),
        (
            ("env=ant", "plan.layout=[[0,1],[2]]", "plan.sm_percent=[30,30.5,40]"),
            "env=ant algo=ppo 'plan.layout=[[0,1],[2]]' 'plan.sm_percent=[30.0,30.5,40.0]'",
        ),
        (
            ("env=ant", "cluster.engine=ray", "cluster.address='[::1]:6379'"),
            "env=ant algo=ppo cluster.engine=ray 'cluster.address=\"[::1]:6379\"'",
        ),
    ],
)
def test_a_job_that_was_stopped_says_how_to_continue_if_it_can(
    tmp_path: Path, chosen: tuple[str, ...], words: str
):
    run = RunPaths(tmp_path)
    config = build("train", TrainConfig, list(chosen))
    assert what_is_left(config, run) == "no run folder is left"
    run.metrics.write_text('{"env_steps": 64}\n')
    stays = f"no checkpoint was saved; the run folder stays: {tmp_path}"
    assert what_is_left(config, run) == stays
    save(run, 64)
    command = f"gmijax train {words} run.dir={tmp_path} run.resume=auto"
    assert what_is_left(config, run) == f"to continue from the last checkpoint: {command}"
    write_json(run.gmi(0).result, {"status": "stopped"})
    assert what_is_left(config, run) == f"the run is saved. To continue: {command}"
    again = build("train", TrainConfig, shlex.split(command)[2:])
    assert (again.plan, again.cluster) == (config.plan, config.cluster)


@pytest.mark.parametrize(
    ("overrides", "left", "stays"),
    [
        ((), None, False),
        ((), "gmi_0/stderr.log", False),
        ((), "gmi_0/attempt_0/stderr.log", True),  # Of a failure.
        ((), "metrics.jsonl", True),
        (("run.name=mine",), None, True),  # A sweep reads how it has ended.
        (("run.dir=mine",), None, True),
    ],
)
@pytest.mark.parametrize("error", [JobInterrupted("stopped"), ConfigError("refused")])
def test_of_a_run_that_never_began_no_folder_is_left(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    overrides: tuple[str, ...],
    left: str | None,
    stays: bool,
    error: GmijaxError,
):
    monkeypatch.chdir(tmp_path)
    config = build("train", TrainConfig, ["env=ant", *overrides])
    messages: list[str] = []

    def begin() -> None:
        with opened(config, StartPoint()) as (run, *_):
            write_json(run.config, {})
            if left is not None:
                (run.root / left).parent.mkdir(parents=True, exist_ok=True)
                (run.root / left).write_text('{"env_steps": 64}\n')
            messages.append(what_is_left(config, run))
            raise error

    with pytest.raises(type(error)):
        begin()
    assert len(list(tmp_path.glob("mine"))) + len(list(tmp_path.glob("runs/*"))) == int(stays)
    assert messages[0].startswith("no checkpoint was saved; the run" if stays else "no run folder")


def test_films_of_others_are_not_ours(run: RunPaths):
    run.videos.mkdir()
    for name in ("000000000100.mp4", "2026-best.mp4", "9.npz", "000000000900.copy.mp4"):
        (run.videos / name).touch()
    assert by_steps(run.videos, suffix=".npz") == []
    summary = {
        **dict.fromkeys(("step_per_s_sim", "step_per_s_inference", "step_per_s_train")),
        **{"status": "completed", "env_steps": 1, "wall_s": 1.0, "final_return": None},
        **{"restarts": [], "checkpoint": None, "overflow_steps": {}},
    }
    assert f"video: {run.videos}/000000000100.mp4\n" in train_outcome(summary, run)
    with filmed(None, run, print):
        pass
    assert (run.videos / "9.npz").exists()


def test_play_names_the_checkpoints_that_there_are(run: RunPaths):
    write_json(run.config, {"env": {}, "algo": {}, "run": {}})
    config = build("play", PlayConfig, [f"run.dir={run.root}", "checkpoint=7"])
    with pytest.raises(
        ConfigError, match=r"^checkpoint=7: no such checkpoint in .*; there are 100, 200, 300$"
    ):
        open_run(config)


@pytest.mark.parametrize("name", ["12", "0" * 13, "00000000001x", " 00000000012", "\u0661" * 12])
def test_other_names_are_no_steps(name: str):
    assert steps_of(name) is None
    assert steps_of(steps_name(12)) == 12


def test_steps_have_no_more_digits_than_a_name():
    with pytest.raises(ConfigError, match="num_timesteps=1000000000000: must be between 1 and"):
        compose("env=ant", "num_timesteps=1e12")


def test_a_folder_that_cannot_be_read_is_not_an_empty_one(
    run: RunPaths, monkeypatch: pytest.MonkeyPatch
):
    def refuse(_: Path) -> list[str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "listdir", refuse)
    with pytest.raises(ConfigError, match=r"checkpoints: cannot be read \(Permission denied\)$"):
        newest_checkpoint(run.root)


def test_gmis_and_shards_of_copies_do_not_count(tmp_path: Path):
    for name in ("gmi_0", "gmi_12", "gmi_0.bak", "gmi_01", "gmi_x"):
        (tmp_path / name).mkdir()
    assert [path.name for path in gmi_folders(tmp_path)] == ["gmi_0", "gmi_12"]
    data = DataPaths(tmp_path / "data")
    shard = data.shard(0, 0)
    shard.arrays.parent.mkdir(parents=True)
    shard.arrays.write_bytes(b"12")
    write_json(shard.about, {"num_bytes": 2})
    for name in ("gmi_0", "gmi_00", "gmi_000.bak"):
        shutil.copytree(data.folder(0), data.root / name)
    assert len(list(data.finished())) == 1


def test_the_last_run_is_the_one_that_was_written_last_whatever_its_files_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    runs = {name: RunPaths(Path("runs") / name) for name in ("a", "b")}
    for written_s, run in zip((2000.0, 1000.0), runs.values(), strict=True):
        meta = CheckpointMeta("ant", "ppo", 100, 1, 8, ((8,), (8,)), "jax", time_s=written_s)
        save_meta(run, meta)
        os.utime(run.checkpoint(100) / META, (written_s, written_s))
    # As `cp -r` does it: copies of files are newer than whatever they are copies of.
    shutil.copytree("runs/b", "runs/copy of b")
    shutil.copytree("runs/a", "runs/copy of a")
    for name in ("copy of a", "copy of b"):
        os.utime(Path("runs") / name / "checkpoints" / steps_name(100) / META, (9000.0, 9000.0))
    assert last_run("run.dir") == runs["a"].root

"""A folder that is moved, removed or replaced under the job that writes into it."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from supervision import machine

from gmijax.cli.compose import compose
from gmijax.config.schema import to_dict
from gmijax.control import packed
from gmijax.errors import ConfigError, FolderLost
from gmijax.learning.checkpoint import save_learner
from gmijax.partition.planner import make_plan
from gmijax.runs.checkpoints import UNFINISHED
from gmijax.runs.folder import RunPaths, add_event, write_json
from gmijax.runs.held import OpenFolder, locked
from gmijax.runs.history import MetricsReader
from gmijax.runs.names import steps_name


def replaced(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (
            lambda folder: folder.rename(folder.with_name("b")),
            "was moved to {}/x/b while",
        ),
        (
            lambda folder: folder.parent.rename(folder.parents[1] / "y"),
            "was moved to {}/y/a while",
        ),
        (shutil.rmtree, "was removed or replaced while"),
        (replaced, "was removed or replaced while"),
        (lambda folder: (shutil.rmtree(folder), folder.touch()), "was removed or replaced while"),
    ],
)
def test_a_folder_that_is_gone_is_noticed(
    tmp_path: Path, harm: Callable[[Path], object], message: str
):
    folder = tmp_path / "x" / "a"
    folder.mkdir(parents=True)
    with locked(folder / ".lock", "run.dir=a") as held:
        held.require()
        harm(folder)
        with pytest.raises(FolderLost, match=f"^run.dir=a: the folder {message.format(tmp_path)}"):
            held.require()


def test_a_folder_that_is_there_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "a"
    folder.mkdir()
    with OpenFolder(folder, "x") as held:
        (folder / "file").touch()
        folder.chmod(0o500)
        # Moved away and back; and a link to where it is now serves as well.
        folder.rename(tmp_path / "b")
        assert not held.is_there()
        folder.symlink_to("b")
        held.require()

        def stat(*_: object) -> None:
            raise OSError(errno.EIO, "the network is gone")

        monkeypatch.setattr(os, "stat", stat)
        held.require()


def test_the_progress_of_packed_runs_goes_on_without_one_that_has_diverged(tmp_path: Path):
    runs = [RunPaths(tmp_path / str(number)) for number in range(2)]
    readers = [MetricsReader(run.metrics) for run in runs]
    for run, last in zip(runs, (10, 30), strict=True):
        run.root.mkdir()
        lines = [json.dumps({"env_steps": steps}) for steps in range(10, last + 1, 10)]
        run.metrics.write_text("\n".join((*lines, "")))
    steps = [line["env_steps"] for line in packed._new_lines(readers)]
    assert steps == [10, 10, 20, 30]


def test_the_end_of_a_packed_run_is_not_that_of_another_run_in_its_place(tmp_path: Path):
    config = compose()
    plan = make_plan(config.plan, config.reduce, 64, machine(0))
    runs = [RunPaths(tmp_path / name) for name in ("000", "001")]
    with ExitStack() as held:
        members: list[packed._Member] = []
        for run in runs:
            run.root.mkdir()
            folder = held.enter_context(OpenFolder(run.root, "x"))
            members.append(packed._Member(config, run, folder))
        runs[0].root.rename(tmp_path / "moved")
        being_saved = runs[0].checkpoints / f".{steps_name(64)}{UNFINISHED}"
        being_saved.mkdir(parents=True)
        for run in runs:
            write_json(run.config, to_dict(config))
        packed._record(members, 0.0, "failed", plan)
    assert being_saved.exists()
    assert [run.summary.exists() for run in runs] == [False, True]


def test_nothing_makes_a_run_folder_anew_that_is_gone(tmp_path: Path):
    run = RunPaths(tmp_path / "x" / "run")
    for write in (
        lambda: save_learner(run, 7, {"w": np.zeros(3)}),
        lambda: write_json(run.gmi(0).result, {}),
        lambda: write_json(run.summary, {}),
    ):
        with pytest.raises(FileNotFoundError):
            write()
    add_event(run.events, "x")
    assert not (tmp_path / "x").exists()


def test_a_folder_that_cannot_be_written_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(*_: object) -> int:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    with (
        pytest.raises(ConfigError, match=r"^x: cannot be locked \(Read-only file system\)$"),
        locked(tmp_path / ".lock", "x"),
    ):
        pass

"""Paths in messages: as they are typed from the working directory, absolute elsewhere."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from supervision import save

from gmijax.cli.compose import build, compose
from gmijax.config import PlayConfig
from gmijax.config.schema import to_dict
from gmijax.deploy.trained_run import checkpoint_of, output_folder
from gmijax.errors import ConfigError, FolderLost
from gmijax.player.policy import checkpoint_policy, read_policy
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint, none_is_whole
from gmijax.runs.folder import META, RunPaths, read_json, write_json
from gmijax.runs.held import OpenFolder
from gmijax.runs.names import as_typed, by_steps, shortened
from gmijax.runs.resume import find_checkpoint
from gmijax.runs.saved_config import config_of_run, saved_config
from gmijax.sim.source import split


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunPaths:
    """A run with two checkpoints below the working directory."""
    monkeypatch.chdir(tmp_path)
    paths = RunPaths(tmp_path / "td")
    paths.root.mkdir()
    write_json(paths.config, to_dict(compose("env=ant")))
    save(paths, 100)
    save(paths, 200)
    return paths


def alone(run: RunPaths) -> object:
    run.config.unlink()
    return saved_config(run.checkpoint(100))


def other(run: RunPaths) -> object:
    write_json(run.config, {"env": 5})
    return config_of_run(run)


def at_step_7(run: RunPaths) -> object:
    return checkpoint_of(build("play", PlayConfig, [f"run.dir={run.root}", "checkpoint=7"]))[0]


def not_made(run: RunPaths) -> object:
    (run.root / "play").touch()
    return written_to(run)


def not_written(run: RunPaths) -> object:
    (run.root / "play" / "000000000100" / "config.json").mkdir(parents=True)
    return written_to(run)


def written_to(run: RunPaths) -> object:
    words = [f"run.dir={run.root}", f"checkpoint={run.checkpoint(100)}"]
    return output_folder(build("play", PlayConfig, words), "play")


def listed(run: RunPaths) -> object:
    run.checkpoints.rename(run.root / "kept")
    run.checkpoints.symlink_to(run.checkpoints)
    return by_steps(run.checkpoints)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda run: read_json(run.plan), "td/plan.json: cannot be read (No such file"),
        (alone, "checkpoint td/checkpoints/000000000100: no config.json in td; "),
        (other, "td/config.json: not the configuration of a training run"),
        (at_step_7, "checkpoint=7: no such checkpoint in td; there are 100, 200"),
        (not_made, "td/play/000000000100: cannot make the folder (Not a directory)"),
        (not_written, "cannot write to td/play/000000000100 (Is a directory)"),
        (listed, "td/checkpoints: cannot be read (Too many levels"),
        (
            lambda run: CheckpointMeta.read(run.checkpoint(7)),
            "checkpoint td/checkpoints/000000000007: broken meta.json (No such file",
        ),
        (
            lambda run: checkpoint_policy(run.checkpoint(100)),
            "checkpoint td/checkpoints/000000000100: has no policy.npz",
        ),
        (lambda run: read_policy(run.config), "td/config.json: not a policy ("),
        (
            lambda run: split(str(run.root / "task.py:make")),
            "env=td/task.py:make: no such file",
        ),
    ],
)
def test_a_file_below_the_working_directory_is_named_from_there(
    run: RunPaths, ask: Callable[[RunPaths], object], message: str
) -> None:
    with pytest.raises(ConfigError) as error:
        ask(run)
    assert str(error.value).startswith(message)


def test_a_file_elsewhere_is_named_whole(run: RunPaths, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.checkpoints)
    with pytest.raises(ConfigError, match=f"^{run.plan}: cannot be read"):
        read_json(run.plan)


def test_a_moved_folder_is_named_where_it_is_now(run: RunPaths) -> None:
    with OpenFolder(run.root, "run.dir=td") as folder:
        run.root.rename("kept")
        with pytest.raises(FolderLost, match=r"^run\.dir=td: the folder was moved to kept while"):
            folder.require()


def test_of_damaged_checkpoints_the_newest_is_named_and_the_others_are_counted(
    run: RunPaths,
) -> None:
    save(run, 300)
    for steps in (100, 200, 300):
        (run.checkpoint(steps) / META).write_text("{")
    found = newest_checkpoint(run.root)
    assert found.passed_over[0].startswith("checkpoint td/checkpoints/000000000300: passed over,")
    with pytest.raises(ConfigError) as error:
        find_checkpoint("td", "run.dir")
    message = str(error.value)
    assert message == f"run.dir=td: {none_is_whole(found)}"
    assert message.startswith("run.dir=td: no checkpoint is whole: td/checkpoints/000000000300: ")
    assert message.endswith(" (and 2 more)")
    assert message.count("broken") == 1
    assert message.count("checkpoints/") == 1


def test_a_program_of_the_working_directory_is_none_of_path(run: RunPaths) -> None:
    assert as_typed(f"{run.root.parent}/x.sh") == f"{os.curdir}/x.sh"
    assert as_typed(f"{run.root}/x.sh") == "td/x.sh"
    for program in ("python", "./x.sh", "/usr/bin/env"):
        assert as_typed(program) == program


@pytest.mark.parametrize(
    ("most", "between", "also", "wanted"),
    [
        (3, ", ", None, "a, b, c"),
        (2, "; ", None, "a; b; and 1 more"),
        (1, ", ", " ", "a and 2 more"),
    ],
)
def test_a_line_lists_the_first_and_counts_the_others(
    most: int, between: str, also: str | None, wanted: str
):
    assert shortened(["a", "b", "c"], most, between, also) == wanted

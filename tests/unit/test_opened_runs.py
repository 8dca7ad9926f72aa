"""Opening a run executes the file of its custom task only if it is the noted one, or named."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import py_compile
from pathlib import Path
from typing import Any

import pytest
from supervision import save_meta

import gmijax
from gmijax.cli.command import command
from gmijax.cli.compose import build
from gmijax.config import ExportConfig, PlayConfig, ViewConfig
from gmijax.config.schema import to_dict
from gmijax.control import job, restarts, serving
from gmijax.deploy import exporting, playing
from gmijax.deploy.viewing import view
from gmijax.errors import ConfigError
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import META, RunPaths, read_json, write_json
from gmijax.sim import source
from gmijax.sim.adapters import custom
from gmijax.sim.registry import make_env

TRAP = "from pathlib import Path\nPath(__file__).with_name('executed').touch()\nmake = None\n"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunPaths:
    """A run of a custom task with a checkpoint, whose file has changed since."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "point.py").write_text("def make(): ...\n")
    config = gmijax.compose("env=point.py:make", "num_envs=8")
    saved = {**to_dict(config), "env": to_dict(source.pinned(config.env))}
    paths = RunPaths(tmp_path / "theirs")
    write_json(paths.config, saved)
    hidden = config.algo.hidden_layer_sizes
    meta = CheckpointMeta("point.py:make", "ppo", 100, 1, 8, hidden, "jax")
    save_meta(paths, meta)
    (tmp_path / "point.py").write_text(TRAP)
    return paths


class StartedError(Exception):
    """Checked all, and would start GMIs now."""


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_gmis(*_: Any) -> None:
        raise StartedError

    for module in (playing, exporting, restarts, serving):
        monkeypatch.setattr(module, "run_gmis", run_gmis)


def opened(kind: str, *overrides: str) -> Any:
    if kind == "play":
        return playing.play(build("play", PlayConfig, ("run.dir=theirs", *overrides)), show=True)
    if kind == "export":
        config = build("export", ExportConfig, ("run.dir=theirs", *overrides))
        return exporting.export(config, show=True)
    if kind == "serve":
        config = gmijax.compose("run.dir=theirs", *overrides, command="serve")
        return serving.serve(config, show=True)
    return job.train(gmijax.compose("run.resume=theirs", *overrides), show=True)


@pytest.mark.parametrize("kind", ["play", "export", "serve", "resume"])
def test_only_the_noted_file_or_one_that_is_named_is_executed(
    kind: str, run: RunPaths, starts: None, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(ConfigError) as error:
        opened(kind)
    assert str(error.value) == (
        "point.py has changed since this run was trained, so it was not executed. To use the file "
        "as it is now, add env=point.py:make"
    )
    with pytest.raises(StartedError):
        opened(kind, "env=point.py:make")
    Path("point.py").write_text("def make(): ...\n")
    with pytest.raises(StartedError):
        opened(kind)
    # What is executed is named before it is.
    notice = "custom task: this executes point.py:make, the file of the run's task"
    assert capsys.readouterr().out.replace("\n", "").count(notice) == 2
    saved = read_json(run.config)
    del saved["env"]["source_sha256"]  # Nothing is noted.
    write_json(run.config, saved)
    with pytest.raises(ConfigError, match="may have changed since this run was trained"):
        opened(kind)


@pytest.mark.parametrize("kind", ["play", "export", "serve", "resume"])
def test_a_damaged_checkpoint_is_named_by_every_command(
    kind: str, run: RunPaths, starts: None, capsys: pytest.CaptureFixture[str]
):
    Path("point.py").write_text("def make(): ...\n")
    meta = CheckpointMeta.read(run.checkpoint(100))
    newest = save_meta(run, dataclasses.replace(meta, env_steps=200))
    (newest / META).write_text("{")
    with pytest.raises(StartedError):
        opened(kind)
    message = "checkpoint theirs/checkpoints/000000000200: passed over, broken meta.json (not JSON"
    assert message in capsys.readouterr().out


def test_play_hands_its_child_the_file_that_it_looked_at(run: RunPaths, starts: None):
    with pytest.raises(StartedError):
        opened("play", "env=point.py:make")
    given = json.loads((run.root / "play" / f"{100:012d}" / "config.json").read_text())["run"]
    digest = hashlib.sha256(TRAP.encode()).hexdigest()
    assert (given["env"], given["env_sha256"]) == (f"{Path('point.py').resolve()}:make", digest)


def test_play_takes_no_other_task(run: RunPaths):
    Path("other.py").write_text(TRAP)
    with pytest.raises(ConfigError, match=r"^env=other\.py:make: the run was trained on point"):
        opened("play", "env=other.py:make")


@pytest.mark.parametrize("overrides", [(), ("env=point.py:make",), ("checkpoint=100",)])
def test_view_refuses_a_custom_task_before_it_looks_at_its_file(
    run: RunPaths, overrides: tuple[str, ...]
):
    refusal = r"^env=point\.py:make: only our own tasks .*; gmijax play films others$"
    for text in ("def make(): ...\n", TRAP):  # As it was, and changed.
        Path("point.py").write_text(text)
        with pytest.raises(ConfigError, match=refusal):
            view(build("view", ViewConfig, ("run.dir=theirs", *overrides)))


def test_only_commands_that_can_use_the_file_of_a_task_offer_it(
    capsys: pytest.CaptureFixture[str],
):
    for name, cls, is_offered in (("view", ViewConfig, False), ("export", ExportConfig, True)):
        command(name, cls, lambda *_, **__: None, ["--help", "all"])
        assert ("PATH.py:FUNCTION" in capsys.readouterr().out) == is_offered


def test_a_gmi_executes_nothing_else_either(run: RunPaths):
    with pytest.raises(ConfigError, match=r"point\.py: has changed since the job was started$"):
        make_env("point.py:make", suite="custom", source_sha256="0" * 64)
    assert not Path("executed").exists()


def test_what_is_executed_is_what_was_looked_at(tmp_path: Path):
    """And not a compiled file beside it, which may hold anything."""
    file = tmp_path / "task.py"
    file.write_text("VALUE = 1\n")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    other = tmp_path / "other.py"
    other.write_text("VALUE = 2\n")
    cached = Path(importlib.util.cache_from_source(str(file)))
    py_compile.compile(
        str(other), str(cached), invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH
    )
    assert custom.load_module(file, digest).VALUE == 1

"""`gmijax view` beside a training that has not saved anything yet."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from supervision import save

from gmijax.cli.compose import build, compose
from gmijax.config import ViewConfig
from gmijax.config.schema import to_dict
from gmijax.control.console import open_console
from gmijax.deploy import viewing
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths, write_json
from gmijax.runs.held import locked


def test_it_waits_for_the_first_checkpoint_of_a_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunPaths(Path("runs") / "x")
    run.root.mkdir(parents=True)
    write_json(run.config, to_dict(compose("env=ant", "run.checkpoint_every=7")))
    polls: list[float] = []

    def sleep(seconds: float) -> None:
        polls.append(seconds)
        if len(polls) == 2:
            save(run, 100)

    monkeypatch.setattr(viewing, "missing", tuple)
    # In place of the module: its function is that of all threads, also of what other tests left.
    monkeypatch.setattr(viewing, "time", SimpleNamespace(sleep=sleep))
    with locked(run.lock, "x"):
        config, env, changed = viewing.opened_once_saved(
            build("view", ViewConfig, ()), open_console(show=True)
        )
    assert (Path(str(config.checkpoint)).name, env.label, changed) == ("000000000100", "ant", None)
    assert len(polls) == 2
    assert capsys.readouterr().out == (
        "waiting: run.dir=last: runs/x: still training, no checkpoint yet; the first is saved "
        "after 7 iterations (run.checkpoint_every)\n"
    )


def test_it_does_not_wait_for_a_task_that_it_cannot_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunPaths(Path("runs") / "x")
    run.root.mkdir(parents=True)
    monkeypatch.setattr(viewing, "missing", tuple)
    config, console = build("view", ViewConfig, ()), open_console(show=False)
    with locked(run.lock, "x"):
        write_json(run.config, to_dict(compose("env=playground", "env.name=CartpoleBalance")))
        with pytest.raises(ConfigError, match="only our own tasks are played without jax"):
            viewing.opened_once_saved(config, console)

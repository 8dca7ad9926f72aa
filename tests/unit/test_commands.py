"""The command `gmijax`: its verbs, the list of tasks, completion in a shell."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from gmijax import demo
from gmijax.__main__ import VERBS, main
from gmijax.cli import help as cli_help
from gmijax.config import PlayConfig, TrainConfig
from gmijax.control import job
from gmijax.control.console import training_of
from gmijax.control.job import Result
from gmijax.deploy import playing
from gmijax.list_envs import task_of
from gmijax.runs.folder import PlayPaths, RunPaths
from gmijax.sim.registry import TASKS
from gmijax.version import __version__


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"]])
def test_help_has_a_line_for_every_verb(argv: list[str], capsys: pytest.CaptureFixture[str]):
    assert main(argv) == 0
    lines = capsys.readouterr().out.splitlines()
    for verb, what in VERBS.items():
        assert f"{verb} {what}" in [" ".join(line.split()) for line in lines]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_a_module_with_help(verb: str, capsys: pytest.CaptureFixture[str]):
    assert main([verb, "--help"]) == 0
    assert capsys.readouterr().out.startswith(f"usage: gmijax {verb}")
    assert callable(importlib.import_module(f"gmijax.{verb.replace('-', '_')}").main)


@pytest.mark.parametrize("line", [["help", "list-envs"], ["list_envs", "--help"]])
def test_help_and_the_name_of_the_module_are_understood(
    line: list[str], capsys: pytest.CaptureFixture[str]
):
    assert main(line) == main(["help"]) == 0
    assert "usage: gmijax list-envs" in capsys.readouterr().out
    assert main(["help", "trian"]) == 2
    assert capsys.readouterr().err == "gmijax: unknown command 'trian': did you mean train?\n"


def test_an_interrupt_while_packages_are_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib, "import_module", interrupted)
    assert main(["train"]) == 130
    assert capsys.readouterr().err == "gmijax.train: interrupted\n"


def test_arguments_and_exit_code_are_those_of_the_verb(capsys: pytest.CaptureFixture[str]):
    assert main(["train", "num_env=3"]) == 2
    assert "unknown key num_env: did you mean num_envs?" in capsys.readouterr().err
    assert main(["list_envs", "ant"]) == 2
    assert main(["demo", "num_timesteps=0"]) == 2


def test_a_demo_with_keys_trains_plays_and_says_what_to_look_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run, played = RunPaths(tmp_path), PlayPaths(tmp_path / "play" / "000000000042")

    def train(config: TrainConfig, *, show: bool) -> Result:
        assert (config.env.name, config.num_timesteps, config.seed) == ("ball_balance", 42, 3)
        run.returns_png.touch()
        return Result(tmp_path, {})

    def play(config: PlayConfig, *, show: bool) -> None:
        assert config.run.dir == str(tmp_path)
        played.root.mkdir(parents=True)
        played.mp4.touch()

    monkeypatch.setattr(job, "train", train)
    monkeypatch.setattr(playing, "play", play)
    monkeypatch.setattr(demo, "show_shipped", lambda *_: None)
    assert main(["demo", "num_timesteps=42", "seed=3"]) == 0
    output = capsys.readouterr().out
    assert f"curve of the returns: {run.returns_png}\n" in output
    assert f"film: {played.mp4}\n" in output


@pytest.mark.parametrize(("typed", "meant"), [("trian", "train"), ("hepl", "help")])
def test_an_unknown_verb_is_one_line_with_a_suggestion(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
):
    assert main([typed]) == 2
    errors = capsys.readouterr().err
    assert errors == f"gmijax: unknown command {typed!r}: did you mean {meant}?\n"


def test_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"gmijax {__version__}\n"


def test_nothing_heavy_is_imported_before_the_verb_is_known():
    code = (
        "import sys, gmijax.__main__ as m; m.main(['--help']); "
        "print({'hydra', 'numpy', 'rich', 'jax'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize("name", TASKS)
def test_listed_sizes_are_those_that_the_task_describes(name: str):
    task = task_of(name)
    module = importlib.import_module(TASKS[name])
    described = str(module.__doc__)
    assert f"Observation [{task.obs_size}]" in described
    assert f"Action [{task.action_size}]" in described
    assert task.episode_length == module.DEFAULT_EPISODE_LENGTH
    assert task.description


def test_list_envs_names_tasks_and_suites(capsys: pytest.CaptureFixture[str]):
    assert main(["list-envs"]) == 0
    output = capsys.readouterr().out
    for name in (*TASKS, "env=brax", "env=playground", "env=PATH.py:FUNCTION"):
        assert name in output


@pytest.mark.parametrize("is_there", [True, False])
def test_help_marks_tasks_that_are_not_installed(
    is_there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    missing = {} if is_there else {"brax": "needs x", "go1": "needs y"}
    monkeypatch.setattr(cli_help, "missing_of", missing.get)
    assert main(["train", "--help"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert ("brax*, custom" in output, "go1*, go1_rough," in output) == (not is_there,) * 2
    assert ("* not installed: gmijax list-envs prints what to install" in output) != is_there
    assert main(["list-envs"]) == 0


@pytest.mark.parametrize(
    ("num_gpus", "task", "command"),
    [
        (1, "ant", "gmijax train env=ant"),
        (0, "ant", "gmijax train env=ball_balance"),
        (0, "ball_balance", "gmijax train env=ball_balance"),
    ],
)
def test_without_a_gpu_no_command_that_trains_for_hours_is_suggested(
    num_gpus: int, task: str, command: str
):
    purpose, line = training_of(task, has_gpu=bool(num_gpus))
    assert line == command
    assert ("needs a GPU" in purpose) == (task not in command)


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("gmijax tr", [*VERBS, "help"]),
        ("gmijax ", [*VERBS, "help"]),
        ("gmijax train env=an", ["env=ant", "env=anymal"]),
        ("gmijax train env=ant plan.gm", ["plan.gmis_per_gpu="]),
        ("gmijax play vid", ["video=", "video_envs="]),
        ("gmijax train plan.template=tdg", ["plan.template=tdg", "plan.template=tdg_ex"]),
        ("gmijax train --help ev", ["eval"]),
        ("gmijax doctor ", []),
    ],
)
def test_completion_of_a_line(
    line: str,
    answer: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("COMP_LINE", line)
    assert main(["-sc", "query=bash"]) == 0
    assert capsys.readouterr().out.split() == answer


def test_the_script_for_bash_is_that_of_hydra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["/bin/gmijax"])
    assert main(["-sc", "install=bash"]) == 0
    assert capsys.readouterr().out.rstrip().endswith("-F hydra_bash_completion gmijax")
    assert main(["-sc", "install=csh"]) == 2
    assert "No completion plugin for 'csh' found" in capsys.readouterr().err

"""Overrides that are refused, and what they say."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from command_lines import run

from gmijax.cli.command import command
from gmijax.cli.compose import compose
from gmijax.config import PlayConfig
from gmijax.errors import ConfigError


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("env=ant,ball_balance",), r"^env=ant,ball_balance: expected one value \(a list "),
        (("plan.gpus=0,1",), r"^plan\.gpus=0,1: expected one value"),
        (("seed=range(1,3)",), r"^seed=range\(1,3\): expected one value"),
        (("hydra.run.dir=x",), r"^unknown key hydra\.run\.dir: did you mean run\.dir\?$"),
        (("+foo.bar=1",), "^unknown key foo"),
        (("env.name=ant",), "^env.name=ant: choose the task with env=ant$"),
        (("env=ball_balance", "env.name=ant"), "choose the task with env=ant$"),
        (("algo.learning_rate=.inf",), "expected a finite number"),
        (("algo.desired_kl=nan",), "^algo.desired_kl=nan: expected a finite number$"),
        (("run=null",), "^run=None: expected a group of keys$"),
    ],
)
def test_refused_overrides_are_told_in_one_line(overrides: tuple[str, ...], message: str):
    with pytest.raises(ConfigError, match=message) as error:
        compose(*overrides)
    assert "\n" not in str(error.value)


def test_a_task_may_be_named_twice():
    assert compose("env=ant", "env.name=ant") == compose("env=ant")


def test_play_has_no_task_to_choose(capsys: pytest.CaptureFixture[str]):
    assert command("play", PlayConfig, lambda _, **__: None, ["env.name=ant"]) == 2
    assert "unknown key env" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "line", "said"),
    [
        ("train", "-env=\n", "unknown option -env=\\n: allowed"),
        ("train", "\r", r"'\r': expected text without control characters"),
        ("train", "run.name=a\nb", "expected text without control characters"),
        ("train", "run.dir=a\0b", "expected text without control characters"),
        ("train", "run.dir=\udcff", r"'run.dir=\udcff': expected text without control"),
        ("train", f"seed={'9' * 5000}", "a number has too many digits"),
        ("train", f"seed={'[' * 3000}{']' * 3000}", "nested too deeply"),
        ("train", f"{'a' * 300}=1", "aaa=1: File name too long"),
        ("train", f"{'a' * 300}/x=1", "aaa/x=1: File name too long"),
        ("train", f"run.resume={'a' * 300}", "aaa: no such folder"),
        ("train", "plan.gpus=1e6", "plan.gmis_per_gpu=1: makes 1000000 GMIs on 1000000 GPUs"),
        ("train", "run.dir={1:2}", "run.dir={1: 2}: expected text or null"),
        ("train", "+=-0.0", "+=-0.0: expected key=value"),
        ("search", "plan.layout=[]", "plan.layout=[]: every GPU needs at least one GMI"),
        ("serve", f"run.dir={'a' * 300}", "aaa: no such folder"),
        ("play", f"checkpoint={'a' * 300}", "aaa: expected the folder of a checkpoint"),
        ("play", f"checkpoint='{'9' * 5000}'", "999: expected the folder of a checkpoint"),
        ("train", f"env={'a' * 300}.py:f", "a.py:f: no such file"),
    ],
)
def test_a_strange_line_is_refused_in_one_line(command: str, line: str, said: str, tmp_path: Path):
    done = run(command, line, cwd=tmp_path)
    assert done.code == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_more_gmis_than_a_host_can_run_are_refused_before_they_are_counted_out():
    for overrides in (
        ("plan.gmis_per_gpu=1025",),
        ("plan.gpus=100", "plan.gmis_per_gpu=11"),
        ("algo=a3c", "plan.gpus=100", "plan.serving_gmis_per_gpu=11"),
        ("algo=a3c", "plan.training_gpus=1e9"),
    ):
        with pytest.raises(ConfigError, match=r"at most 1024 are allowed$"):
            compose(*overrides)
    assert compose("plan.gpus=1024").plan.gpus == 1024


@pytest.mark.parametrize("value", ["a\nb", os.fsdecode(b"a\xffb")])
def test_what_the_environment_has_is_text_too(value: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("A_NAME", value)
    with pytest.raises(ConfigError, match=r"^'run\.name=a.*b': expected text without"):
        compose("run.name=${oc.env:A_NAME}")

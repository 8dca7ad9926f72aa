"""Overrides that are refused, and what they say."""

from __future__ import annotations

import pytest

from gmijax.cli import command, compose
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
    assert command("play", PlayConfig, lambda _: 0, ["env.name=ant"]) == 2
    assert "unknown key env" in capsys.readouterr().err

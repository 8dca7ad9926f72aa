"""Bad input: one line on standard error, exit code 2, nothing started.

Most lines run in this process, some in one of their own, as a user's do.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from command_lines import run
from training_jobs import train


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["env=antt"], "env=antt: unknown: did you mean ant?"),
        (["num_env=3"], "unknown key num_env: did you mean num_envs?"),
        (["algo.gamma=0.9"], "unknown key algo.gamma"),
        (["num_envs=many"], "num_envs=many: expected an integer"),
        (["num_envs=0"], "num_envs=0: must be at least 1"),
        (["num_envs=3", "algo.unroll_length=1"], "do not divide into algo.num_minibatches=4"),
        (["plan.backend=mps"], "plan.backend=mps"),
        (["plan.backend=mig"], "plan.backend=mig"),
        (["plan.backend=share"], "plan.backend=share"),
        (["plan.backend=fpga"], "expected one of auto, mps, mig, share, cpu"),
        (["plan.gpus=0"], "plan.gpus=0: must be at least 1"),
        (["plan.layout=[[0,2]]"], "GMI ids must be 0 to 1"),
        (["reduce.strategy=telepathy"], "expected one of auto, mpr, mrr, har, flat"),
        (["reduce.strategy=mrr", "plan.layout=[[0,1],[2]]"], "cannot run on layout [[0,1],[2]]"),
        (["reduce.strategy=mrr", "plan.gmis_per_gpu=2"], "mrr: cannot run on layout [[0,1]]: its"),
        (["reduce.strategy=flat", "plan.gmis_per_gpu=2"], "NCCL before 2.30"),
        (["reduce.intra=ipc", "plan.gmis_per_gpu=2"], "reduce.intra=ipc: cannot run on layout"),
        (["run.dir=."], "the run folder exists already"),
        (["run.resume=nowhere"], "run.resume=nowhere: no such folder"),
        (["run.resume=last"], "no run with a checkpoint"),
        (["env=ant,ball_balance"], "env=ant,ball_balance: expected one value"),
        (["hydra.run.dir=x"], "unknown key hydra.run.dir"),
        (["env.name=ant"], "env.name=ant: choose the task with env=ant"),
        (["env=brax"], "env.name: must be given with env=brax, e.g. env.name=ant"),
        (["env=nowhere.py:make"], "env=nowhere.py:make: no such file"),
        (["env=nowhere.py"], "env=nowhere.py: expected PATH.py:FUNCTION"),
        (["env=ant", "env.randomize=maybe"], "env.randomize=maybe: expected one of off, on"),
        (["env=ant", "env.randomization.body_mass.range=[2,1]"], "expected [lowest, highest]"),
        (
            ["env=ant", "env.randomization.body_mass.operation=x"],
            "expected one of scale, add, set",
        ),
        (
            ["env=ant", "+env.randomization.body_mas={operation:scale,range:[1,2]}"],
            "env.randomization.body_mas: cannot be randomized: did you mean body_mass?",
        ),
        (["algo.learning_rate=inf"], "algo.learning_rate=inf: expected a finite number"),
        (["algo.learning_rate=1"], "must be between 1e-05 and 0.01 with algo.learning_rate_sch"),
        (["--verbose"], "unknown option --verbose"),
        (["ant"], "ant: expected key=value"),
    ],
)
def test_one_line_and_exit_code_two(overrides: list[str], said: str, tmp_path: Path) -> None:
    done = run("train", *overrides, cwd=tmp_path)
    assert done.code == 2, done.stderr
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "overrides", "said"),
    [
        ("train", ["env=antt"], "env=antt: unknown: did you mean ant?"),
        # All checks but the last one are behind.
        ("train", ["run.dir=."], "the run folder exists already"),
        ("search", ["num_env=3"], "unknown key num_env: did you mean num_envs?"),
        ("serve", ["policy=random", "num_envs=0"], "num_envs=0: must be at least 1"),
        ("play", [], "run.dir=last: no run with a checkpoint"),
        ("doctor", ["gpu=x"], "gpu=x: allowed are --json"),
    ],
)
def test_so_does_the_process_of_every_command(
    command: str, overrides: list[str], said: str, tmp_path: Path
) -> None:
    done = train(*overrides, cwd=tmp_path, command=command)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_help_lists_every_key(tmp_path: Path) -> None:
    done = train("--help", cwd=tmp_path)
    assert done.returncode == 0
    for key in ("num_envs", "plan.gmis_per_gpu", "algo.learning_rate", "run.resume", "seed"):
        assert f"\n{key} " in done.stdout


def test_cfg_job_prints_the_composed_configuration(tmp_path: Path) -> None:
    done = train("--cfg", "job", "env=ant", "num_timesteps=30e6", cwd=tmp_path)
    assert done.returncode == 0
    assert "num_timesteps: 30000000" in done.stdout
    assert "name: ant" in done.stdout

"""Jobs whose worlds have models of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_jobs import STEPS, TINY, train

pytestmark = pytest.mark.timeout(300)

ON = "env.randomize=on"


def test_one_gmi_and_two_train_in_randomised_worlds(tmp_path: Path) -> None:
    returns = {}
    for name, randomize in (("on", "true"), ("off", "off")):
        done = train(
            *TINY,
            f"env.randomize={randomize}",
            *("env.episode_length=8", f"num_timesteps={4 * STEPS}", f"run.dir={name}"),
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
        saved = json.loads((tmp_path / name / "config.json").read_text())
        assert saved["env"]["randomize"] == ("off" if name == "off" else "on")
        lines = (tmp_path / name / "metrics.jsonl").read_text().splitlines()
        returns[name] = [json.loads(line)["return"] for line in lines]
    assert returns["on"] != returns["off"]
    two = train(
        *TINY,
        ON,
        *("plan.gmis_per_gpu=2", f"num_timesteps={2 * 2 * STEPS}", "run.dir=two"),
        cwd=tmp_path,
    )
    assert two.returncode == 0, two.stderr


def test_a_name_that_the_model_does_not_have_is_bad_input(tmp_path: Path) -> None:
    done = train(
        *TINY, ON, "env.randomization.body_mass.names=[torso]", "run.dir=run", cwd=tmp_path
    )
    assert done.returncode == 2, done.stderr
    assert "env.randomization.body_mass.names=torso: ball_balance has no such name" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1

"""Evaluations within real jobs, their best checkpoint, and what they must not change."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from training_jobs import POINT, STEPS, learner_arrays, train

TWO = 2 * STEPS
"""Environment steps of one iteration of two GMIs."""
JOB = (*POINT, "plan.gpus=2", "run.keep_checkpoints=null", "run.checkpoint_every=0")
EVALUATED = ("eval.episodes=5", f"eval.every={2 * TWO}", "run.dir=run", "run.resume=auto")


@pytest.mark.timeout(400)
def test_evaluations_find_the_best_checkpoint_and_change_nothing(tmp_path: Path) -> None:
    commands = (
        (*EVALUATED, f"num_timesteps={5 * TWO}"),
        (*EVALUATED, f"num_timesteps={8 * TWO}"),  # Goes on.
        ("run.dir=without", f"num_timesteps={8 * TWO}"),
    )
    for command in commands:
        done = train(*JOB, *command, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("evaluation: return " in done.stdout) == ("run.dir=run" in command)
    run = tmp_path / "run"
    lines = [json.loads(text) for text in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [k * TWO for k in range(1, 9)]
    found = {line["env_steps"]: line["eval/return"] for line in lines if "eval/return" in line}
    # The first command ended after five iterations, with an evaluation.
    assert list(found) == [k * TWO for k in (2, 4, 5, 6, 8)]
    assert all(line["time/eval_s"] > 0 for line in lines if "eval/return" in line)
    assert {"eval/return_std", "eval/length", "eval/distance"} <= lines[1].keys()

    # A checkpoint at the end of each command, and wherever an evaluation was the best so far.
    record = np.maximum.accumulate(list(found.values()))
    new = [s for s, a, b in zip(found, [-np.inf, *record], record, strict=False) if b > a]
    kept = sorted(int(path.name) for path in (run / "checkpoints").iterdir())
    assert kept == sorted({*new, 5 * TWO, 8 * TWO})
    best = max(found, key=found.__getitem__)
    checkpoint = run / "checkpoints" / f"{best:012d}"
    assert json.loads((run / "summary.json").read_text())["eval"] == {
        "last": {"env_steps": 8 * TWO, "return": found[8 * TWO]},
        "best": {"env_steps": best, "return": found[best], "checkpoint": str(checkpoint)},
    }
    # By which `checkpoint=best` finds it.
    assert json.loads((checkpoint / "meta.json").read_text())["eval_return"] == found[best]
    assert json.loads((tmp_path / "without" / "summary.json").read_text())["eval"] is None
    for a, b in zip(learner_arrays(run), learner_arrays(tmp_path / "without"), strict=True):
        np.testing.assert_array_equal(a, b)

"""A job whose environments have models of their own, and the example of a task in a file."""

from __future__ import annotations

import json
from pathlib import Path

from training_jobs import TINY, train

EXAMPLE = Path(__file__).parents[2] / "examples" / "custom_task.py"


def test_the_example_trains_in_randomised_environments(tmp_path: Path) -> None:
    done = train(
        *(f"env={EXAMPLE}:make", *TINY[1:], "num_timesteps=128"),
        *(
            "env.randomize=true",
            "+env.randomization.body_mass={operation: scale, range: [0.5, 2]}",
        ),
        "run.dir=run",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    env = json.loads((tmp_path / "run" / "config.json").read_text())["env"]
    assert (env["randomize"], list(env["randomization"])) == ("on", ["body_mass"])
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["env_steps"] for line in lines] == [64, 128]

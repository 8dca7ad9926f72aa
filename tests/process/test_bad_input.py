"""Bad input in the process of every command; tests/unit/test_cli.py has all other lines."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_jobs import train


@pytest.mark.parametrize(
    ("command", "overrides", "message"),
    [
        # All checks but the last one are behind.
        ("train", ["run.dir=."], "the run folder exists already"),
        ("search", ["num_env=3"], "unknown key num_env: did you mean num_envs?"),
        ("serve", ["policy=random", "num_envs=0"], "num_envs=0: must be at least 1"),
        ("play", [], "run.dir=last: no run with a checkpoint"),
        ("export", [], "run.dir=last: no run with a checkpoint"),
        ("pack", ["seed=0,1", "--", "true", "{sed}"], "seed=0,1: the command has no {seed}"),
        ("doctor", ["gpu=x"], "gpu=x: expected one of --json"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_two(
    command: str, overrides: list[str], message: str, tmp_path: Path
) -> None:
    done = train(*overrides, cwd=tmp_path, command=command)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []

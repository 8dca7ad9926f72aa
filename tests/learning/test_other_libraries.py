"""Trainers of others learn `ball_balance` by the lines of docs/other-libraries.md.

They are skipped where they are not installed: nothing else needs torch.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from training_jobs import child_environment

EXAMPLE = Path(__file__).parents[2] / "examples" / "other_libraries.py"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("library", "package"),
    [("sb3", "stable_baselines3"), ("rsl_rl", "rsl_rl"), ("skrl", "skrl")],
)
def test_a_trainer_of_others_learns(library: str, package: str, tmp_path: Path):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    environment = child_environment() | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    done = subprocess.run(
        [sys.executable, EXAMPLE, library, "--num-steps", "200000"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=880,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = re.search(r"of the first \d+: ([\d.]+),\s+of the last \d+: ([\d.]+)", done.stdout)
    assert found is not None, done.stdout
    first, last = map(float, found.groups())
    # The short run of a default: 1.4 to 2.2 times as much.
    assert last > 1.2 * first, done.stdout

"""Warnings about a training that is large for a machine without a GPU."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gmijax.cli.compose import compose
from gmijax.control.large_on_cpu import large_on_cpu

TUNED = Path(__file__).parents[2] / "configs" / "tuned"
SHIPPED = sorted(
    path.stem.rpartition("_")[::2]
    for path in TUNED.glob("*.yaml")
    # Those of Playground are for `tuned=`.
    if (TUNED.parent / "env" / f"{path.stem.rpartition('_')[0]}.yaml").exists()
)


@pytest.mark.parametrize(("env", "algo"), SHIPPED)
def test_shipped_settings_of_robots_are_for_a_gpu_and_the_small_try_is_allowed(
    env: str, algo: str
) -> None:
    config = compose(f"env={env}", f"algo={algo}")
    assert large_on_cpu(config, on_cpu=False) == ()
    warnings = large_on_cpu(config, on_cpu=True)
    if env == "ball_balance":
        assert warnings == ()
        return
    (line,) = warnings
    assert f"{config.num_envs:,} environments for {config.num_timesteps:,} steps" in line
    words = line.rpartition("add ")[2].split()
    assert "num_envs=64" in words
    assert large_on_cpu(compose(f"env={env}", f"algo={algo}", *words), on_cpu=True) == ()


@pytest.mark.parametrize(
    ("overrides", "is_large"),
    [
        (("env=custom", "env.name=cart.py:make"), False),  # 1,024 environments for 10M steps.
        (("env=ball_balance", "num_envs=8192", "num_timesteps=1e8"), True),
        (("env=ball_balance", "num_envs=8192", "num_timesteps=1e6"), False),
        (("env=ant", "num_envs=512"), False),
        (("env=ant", "num_envs=auto"), False),
        (("env=ball_balance", "algo=sac", "num_envs=4096", "num_timesteps=3e7"), True),
    ],
)
def test_it_goes_by_environments_and_steps(overrides: tuple[str, ...], is_large: bool) -> None:
    warnings = large_on_cpu(compose(*overrides), on_cpu=True)
    assert bool(warnings) == is_large
    is_sac = "algo=sac" in overrides
    assert all(bool(re.search(r" algo\.batch_size=\d+$", line)) == is_sac for line in warnings)

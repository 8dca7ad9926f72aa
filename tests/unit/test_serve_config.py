"""What `gmijax.serve` can be told, and what it refuses."""

from __future__ import annotations

import pytest

import gmijax
from gmijax.errors import ConfigError


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ([], "policy=trained: needs run.dir=RUN"),
        (["policy=random", "deterministic=true"], "random actions have no mean"),
        (["policy=random", "plan.template=tcg_ex"], "not for gmijax.serve; allowed are auto, tcg"),
        (["policy=random", "plan.template=tgc"], "plan.template=tgc: expected one of auto, tcg"),
        (["policy=random", "num_envs=0"], "num_envs=0: must be at least 1"),
        (["policy=random", "latency_steps=-1"], "latency_steps=-1: must be between"),
        (["policy=random", "output.shards=1"], "unknown key output.shards"),
        (["policy=clever"], "policy=clever: expected one of trained, random"),
        (["run.dir=nowhere"], "run.dir=nowhere: no such folder"),
        (["env=antt"], "env=antt: unknown: did you mean ant?"),
    ],
)
def test_bad_input_is_one_clear_line(overrides: list[str], said: str):
    with pytest.raises(ConfigError) as caught:
        gmijax.compose(*overrides, command="serve")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_steps_are_split_over_the_gmis_that_simulate():
    config = gmijax.compose("policy=random", "num_envs=8", "num_timesteps=100", command="serve")
    assert config.unroll_length == 64
    assert config.unrolls_per_gmi(1) == 1
    many = gmijax.compose(
        "policy=random", "num_envs=8", "unroll_length=2", "num_timesteps=100", command="serve"
    )
    assert many.unrolls_per_gmi(2) == 4  # 4 x 2 GMIs x 8 x 2 = 128 >= 100


def test_a_pipe_takes_two_steps_of_a_thousand_numbers_per_environment():
    config = gmijax.compose("policy=random", "num_envs=4096", command="serve")
    assert config.pipe_bytes >= 2 * 4096 * 1000 * 4

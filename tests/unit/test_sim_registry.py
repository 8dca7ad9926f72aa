import subprocess
import sys

import pytest

from gmijax.errors import ConfigError
from gmijax.sim.registry import make_env, task_names


def test_unknown_task_lists_the_names():
    with pytest.raises(
        ConfigError, match=r"env=antt: unknown task; allowed are ant, anymal, ball_balance, "
    ):
        make_env("antt")


def test_episode_length_must_be_positive():
    with pytest.raises(ConfigError, match=r"env\.episode_length=0: must be at least 1"):
        make_env("ant", episode_length=0)


def test_names_are_known_without_jax_and_mujoco():
    code = (
        "import sys; from gmijax.sim.registry import task_names; "
        "assert 'ant' in task_names(); "
        "assert not {'jax', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_names_are_sorted():
    assert list(task_names()) == sorted(task_names())

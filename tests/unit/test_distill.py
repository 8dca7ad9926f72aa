"""A student learns from a teacher that it finds by its run folder, and may see less than it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from made_checkpoint import make_run
from toy_env import point_mass

import gmijax
from gmijax.collectives.program import LocalCollectives
from gmijax.distill.distill import DISTILL
from gmijax.distill.teacher import load_teacher
from gmijax.errors import ConfigError
from gmijax.learning.start import begin_episodes

ENV = point_mass()
NUM_ENVS, LENGTH = 32, 8


def student_of(teacher: Path, *overrides: str) -> Any:
    return gmijax.compose(
        *("env=ball_balance", "algo=distill", f"algo.teacher={teacher}", f"num_envs={NUM_ENVS}"),
        *(f"algo.unroll_length={LENGTH}", "algo.policy_hidden_layer_sizes=[16]", *overrides),
    ).algo


@pytest.mark.parametrize("seen", [None, 1])
def test_the_student_comes_to_act_as_the_teacher_does(tmp_path: Path, seen: int | None) -> None:
    make_run(
        tmp_path, "algo.policy_obs_key=privileged_state", obs_size=2, action_size=1,
        actor_obs_size=seen or 2,
    )  # fmt: skip
    spec = ENV.spec._replace(actor_obs_size=seen or 2)
    learner = DISTILL.make_learner(spec, student_of(tmp_path))
    assert learner.extra.networks.actor_obs_size is None  # It sees all.
    assert learner.networks.actor_obs_size == (seen or 2)
    state = jax.jit(partial(DISTILL.init, learner, 2))(jax.random.key(0))
    envs = begin_episodes(ENV, jax.random.key(1), 0, NUM_ENVS, kept_steps=LENGTH)
    iterate: Any = jax.jit(partial(DISTILL.iterate, ENV, learner, LocalCollectives(), ENV.model))
    losses = []
    for _ in range(30):
        state, envs, metrics = iterate(state, envs)
        losses.append(float(metrics.losses.imitation_loss))
    # What the student does not see it cannot imitate.
    assert np.mean(losses[-5:]) < (0.2 if seen is None else 0.9) * losses[0]
    assert float(np.exp(state.params.log_std)[0]) == pytest.approx(0.1)  # Its noise stays.


def test_a_teacher_of_other_sizes_is_refused(tmp_path: Path) -> None:
    make_run(tmp_path / "teacher")
    with pytest.raises(ConfigError, match="24 observations and 3 actions; point_mass has 2"):
        load_teacher(str(tmp_path / "teacher"), ENV.spec)
    with pytest.raises(ConfigError, match=r"^algo\.teacher=.*nobody: no such folder"):
        load_teacher(str(tmp_path / "nobody"), ENV.spec)


def test_a_student_needs_a_teacher() -> None:
    with pytest.raises(ConfigError, match=r"^algo\.teacher=null: .*; expected its run folder"):
        gmijax.compose("env=ball_balance", "algo=distill")

"""The learning rate of a job that goes on: that of the schedule, unless another one is given."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from made_checkpoint import ACTION_SIZE, ENV_STEPS, OBS_SIZE, TINY, make_run

import gmijax
from gmijax.config.schema import to_dict
from gmijax.learning.learner import init_learner, make_learner
from gmijax.learning.start import first_state
from gmijax.runs.folder import RunPaths, write_json
from gmijax.sim.interface import EnvSpec


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunPaths:
    return make_run(tmp_path_factory.mktemp("runs") / "made")


@pytest.mark.parametrize("override", ["algo.learning_rate=0.001", "algo.gae_lambda=0.9"])
def test_a_rate_that_is_given_counts_also_where_the_run_goes_on_in_its_own_folder(
    run: RunPaths, override: str
):
    checkpoint: Path = run.checkpoint(ENV_STEPS)
    config = gmijax.compose(*TINY, override)
    resumed = dataclasses.replace(config.run, resume=str(checkpoint))
    # As the controller does it before it starts the GMIs.
    write_json(run.config, to_dict(config))
    learner = make_learner(EnvSpec("x", OBS_SIZE, ACTION_SIZE, 0.0, 0, ()), config.algo)
    state, steps = first_state(
        init_learner, learner, OBS_SIZE, dataclasses.replace(config, run=resumed)
    )
    assert steps == ENV_STEPS
    # The checkpoint's own is 0, which no command can ask for.
    wanted = 0.001 if "learning_rate" in override else 0.0
    assert float(state.learning_rate) == pytest.approx(wanted)

"""The communicator of jobs in which only some GMIs train."""

from __future__ import annotations

import os
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from supervision import machine

from gmijax.cli.compose import compose
from gmijax.collectives.host.shared_block import create_exchange
from gmijax.errors import CollectiveTimeout, GmiFailed, ReportedError
from gmijax.runs.folder import RunPaths
from gmijax.supervise.child import ChildLink
from gmijax.supervise.failures import first_cause
from gmijax.supervise.job_kinds import groups_of, training_plan
from gmijax.workers.training_worker import _trainers_communicator


def test_a_trainer_that_does_not_come_is_known_by_its_id(tmp_path) -> None:
    config: Any = compose(
        *("env=ball_balance", "num_envs=16", "algo.num_minibatches=1", "run.start_timeout_s=0.3"),
        *("plan.template=tdg_ex", "plan.gpus=2", "plan.gmis_per_gpu=2"),
    )
    plan = training_plan(config, machine(0))
    agents, of_trainers = groups_of(plan)
    agent, trainers = agents.gmis[0], of_trainers.gmis
    fd = create_exchange()
    assert trainers == (0, 2)  # Of the ranks 0 and 1.
    waiting = ChildLink(trainers[0], RunPaths(tmp_path), None, fd)
    comm = _trainers_communicator(config, plan, of_trainers, waiting, 1, None, None)
    os.close(fd)
    with closing(comm), pytest.raises(CollectiveTimeout) as late:
        comm.all_gather(np.zeros(1, np.float32))
    assert late.value.missing == trainers[1:]

    # The agent waited for the first trainer, and that one for the second, which hangs.
    def failed(gmi: int, missing: tuple[int, ...]) -> GmiFailed:
        error = ReportedError("CollectiveTimeout", "late", "", missing)
        return GmiFailed(gmi, "late", error=error, exit_code=1)

    victims = [failed(agent, trainers[:1]), failed(trainers[0], late.value.missing)]
    assert first_cause(victims) is victims[1]

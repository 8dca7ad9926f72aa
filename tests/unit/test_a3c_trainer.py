"""What a trainer makes of experience that is too old."""

from __future__ import annotations

import numpy as np
import pytest
from toy_env import point_mass

from gmijax.a3c.job_registers import JobRegisters
from gmijax.a3c.trainer import Trainer
from gmijax.channels.experience import Rollouts, Spec
from gmijax.cli.compose import compose
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.runs.folder import RunPaths
from gmijax.supervise.child import ChildLink


class _Arrivals:
    """A receiver that gives out batches of these versions."""

    def __init__(self, *versions: list[int]) -> None:
        self._batches = [
            Rollouts(Spec(()), {}, np.array(one, np.int64), np.ones(len(one), np.int64))
            for one in versions
        ]

    def receive(self, batch_size: int, timeout_s: float) -> Rollouts:
        return self._batches.pop(0)


def _trainer(tmp_path, *versions: list[int]) -> Trainer:
    """A trainer of version 10 that unrolls may be 3 versions behind."""
    trainer = Trainer(
        compose("env=ball_balance", "algo=a3c", "num_envs=4", "algo.max_staleness=3"),
        point_mass(),
        (1,),
        JobRegisters(None, None, ()),
        _Arrivals(*versions),
        SingleRankCommunicator(),
        ChildLink(0, RunPaths(tmp_path), None, None),
    )
    trainer._version = 10
    return trainer


def test_unrolls_of_batches_that_are_passed_over_count_as_stale(tmp_path) -> None:
    trainer = _trainer(tmp_path, [1, 2, 3, 4], [10, 10, 9, 2], [10, 10, 10, 10])
    first, second = (trainer._meet(*trainer._receive()) for _ in range(2))
    assert (first.fresh, first.stale, first.staleness.sum()) == (3, 5, 8)
    assert first.staleness[[0, 1, 6, 7, 8, 9]].tolist() == [2, 1, 1, 1, 2, 1]
    assert (second.fresh, second.stale, second.staleness.sum()) == (4, 0, 4)


def test_fresh_unrolls_weigh_as_much_as_those_of_all_trainers(tmp_path) -> None:
    trainer = _trainer(tmp_path, [10, 2, 2, 2])
    batch, waited_s = trainer._receive()
    mine = trainer._meet(batch, waited_s)
    assert (trainer._weights_of(batch) * trainer._scale(mine)).tolist() == [4, 0, 0, 0]
    # With another trainer that has four of four.
    trainer.comm.world_size = 2
    assert float(trainer._scale(mine._replace(fresh=5.0))) == pytest.approx(8 / 5)

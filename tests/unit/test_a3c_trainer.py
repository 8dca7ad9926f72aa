"""What a trainer makes of experience that is too old."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gmijax.a3c.fresh_batches import FreshBatches
from gmijax.a3c.targets import Unrolls
from gmijax.channels.experience import Rollouts, Spec
from gmijax.cli.compose import compose
from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.runs.folder import RunPaths
from gmijax.supervise.child import ChildLink

VERSION = 10
"""Of the trainer's weights; unrolls may be three versions behind."""


class _Arrivals:
    """A receiver that gives out batches of these versions."""

    def __init__(self, *versions: list[int]) -> None:
        self._batches = [
            Rollouts(
                Spec(()),
                dict.fromkeys(Unrolls._fields, np.zeros((1, len(one)), np.float32)),
                np.array(one, np.int64),
                np.ones(len(one), np.int64),
            )
            for one in versions
        ]

    def receive(self, batch_size: int, timeout_s: float) -> Rollouts:
        return self._batches.pop(0)


class _WithAnother(SingleRankCommunicator):
    """Beside a second trainer, whose values of its batch are `other`."""

    world_size = 2
    other: np.ndarray

    def all_gather(self, values: np.ndarray) -> np.ndarray:
        return np.stack([values, self.other])


def _batches(
    tmp_path: Path, *versions: list[int], comm: SingleRankCommunicator | None = None
) -> FreshBatches:
    config = compose("env=ball_balance", "algo=a3c", "num_envs=4", "algo.max_staleness=3")
    link = ChildLink(0, RunPaths(tmp_path), None, None)
    arrivals = _Arrivals(*versions)
    return FreshBatches(config, arrivals, comm or SingleRankCommunicator(), link)


def test_unrolls_of_batches_that_are_passed_over_count_as_stale(tmp_path: Path) -> None:
    batches = _batches(tmp_path, [1, 2, 3, 4], [10, 10, 9, 2], [10, 10, 10, 10])
    first, second = (batches.take(VERSION, 0).counts for _ in range(2))
    assert (first.fresh, first.stale, first.staleness.sum()) == (3, 5, 8)
    assert first.staleness[[0, 1, 6, 7, 8, 9]].tolist() == [2, 1, 1, 1, 2, 1]
    assert (second.fresh, second.stale, second.staleness.sum()) == (4, 0, 4)


def test_fresh_unrolls_weigh_as_much_as_those_of_all_trainers(tmp_path: Path) -> None:
    alone = _batches(tmp_path, [10, 2, 2, 2]).take(VERSION, 0)
    assert alone.weights.tolist() == [4, 0, 0, 0]
    # With another trainer that has four of four.
    comm = _WithAnother()
    comm.other = np.zeros(4 + len(alone.counts.staleness), np.float32)
    comm.other[1] = 4.0
    both = _batches(tmp_path, [10, 2, 2, 2], comm=comm).take(VERSION, 0)
    assert both.counts.fresh == 5
    assert both.weights == pytest.approx([8 / 5, 0, 0, 0])

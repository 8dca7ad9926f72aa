"""What a trainer learns from: batches with something fresh enough, weighed for all trainers."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gmijax.a3c.report import MAX_COUNTED, BatchCounts, histogram_of
from gmijax.a3c.targets import Unrolls
from gmijax.channels.batcher import Batcher
from gmijax.channels.experience import Rollouts
from gmijax.clock import running_s
from gmijax.collectives.interface import Communicator
from gmijax.config import A3cConfig, TrainConfig
from gmijax.errors import CollectiveTimeout
from gmijax.supervise.child import ChildLink

_SLICE_S = 0.5
"""Longest wait for experience before the trainer sends a heartbeat."""


class FreshBatch(NamedTuple):
    """One batch of B unrolls.

    Attributes:
      unrolls: valid until the next batch is taken.
      weights: [B], of a fresh unroll equal to that of any other of the job; 0 of a stale one.
      counts: of all trainers.
    """

    unrolls: Unrolls
    weights: npt.NDArray[np.float32]
    counts: BatchCounts


class FreshBatches:
    """Takes the batches of one trainer, and announces them to the other trainers."""

    def __init__(
        self,
        config: TrainConfig,
        receiver: Batcher,
        comm: Communicator,
        link: ChildLink,
    ) -> None:
        assert isinstance(config.algo, A3cConfig)
        self._config, self._algo = config, config.algo
        self._batch_size = config.algo.batch_of(config.envs_per_gmi)
        self._receiver, self._comm, self._link = receiver, comm, link
        self._passed_over = np.zeros(MAX_COUNTED + 1, np.float32)

    def take(self, version: int, updates: int) -> FreshBatch:
        """The next batch with at least one unroll that is fresh enough, on every trainer.

        Args:
          version: of the weights now.
          updates: that this trainer has made.

        Raises:
          CollectiveTimeout: no experience comes, or a trainer does not.
          PeerLost: another GMI is gone.
        """
        batch, waited_s = self._receive(version, updates)
        fresh = self._fresh(batch, version)
        behind = histogram_of(version - batch.versions) + self._passed_over
        self._passed_over[:] = 0.0
        num_fresh = float(fresh.sum())
        head = [self._link.stop_requested, num_fresh, float(behind.sum()) - num_fresh, waited_s]
        mine = np.concatenate([head, behind])
        gathered = self._comm.all_gather(mine.astype(np.float32))
        stop, of_all, stale, _ = (float(x) for x in gathered[:, :4].sum(axis=0))
        counts = BatchCounts(
            stop, of_all, stale, float(gathered[:, 3].max()), gathered[:, 4:].sum(axis=0)
        )
        scale = np.float32(self._comm.world_size * self._batch_size / of_all)
        return FreshBatch(Unrolls(**batch.experience), fresh * scale, counts)

    def _receive(self, version: int, updates: int) -> tuple[Rollouts, float]:
        """The next batch with something fresh in it, and the wait for it, seconds."""
        started, since = time.monotonic(), running_s()
        # At first the agents may still compile.
        times = self._config
        limit_s = times.reduce.timeout_s if updates else times.run.start_timeout_s
        while True:
            try:
                batch = self._receiver.receive(self._batch_size, _SLICE_S)
            except CollectiveTimeout as error:
                waited_s = running_s() - since
                if waited_s > limit_s:
                    raise CollectiveTimeout(
                        self._link.gmi, error.missing, "receive", updates, limit_s
                    ) from None
            else:
                if self._fresh(batch, version).any():
                    return batch, time.monotonic() - started
                self._passed_over += histogram_of(version - batch.versions)
                since = running_s()
            if updates:
                self._link.beat("running", updates)

    def _fresh(self, batch: Rollouts, version: int) -> npt.NDArray[np.float32]:
        """[B]: 1 for unrolls within the bound of staleness, 0 for others."""
        if self._algo.max_staleness is None:
            return np.ones(self._batch_size, np.float32)
        fresh = version - batch.versions <= self._algo.max_staleness
        return fresh.astype(np.float32)

"""Writes checkpoints beside the training of one or several GMIs.

A checkpoint takes some tenths of a second, most of it in the file system. So every GMI copies its
part to the host and trains on, while a thread writes it. The leader gives the checkpoint its name
when all parts are there.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gmijax.collectives.interface import Communicator
from gmijax.learning.checkpoint import finish_checkpoint, on_host, save_envs, save_learner
from gmijax.learning.report_thread import ReportThread
from gmijax.runs.folder import RunPaths
from gmijax.runs.resume import CheckpointMeta
from gmijax.types import PyTree


class CheckpointSaver:
    """The checkpoints of a GMI that trains; all of them make the same calls.

    Args:
      run: the run folder.
      gmi: whose environments these are.
      comm: among the GMIs that train.
      keep: as of `finish_checkpoint`.
    """

    def __init__(self, run: RunPaths, gmi: int, comm: Communicator, keep: int | None) -> None:
        self._run, self._gmi, self._comm, self._keep = run, gmi, comm, keep
        self._thread = ReportThread(_call)
        self._unnamed: CheckpointMeta | None = None
        self._last: Path | None = None

    @property
    def is_written(self) -> bool:
        """Whether this GMI's part of a checkpoint that has no name yet is on the disk.

        Raises what has kept it, or the checkpoint before, from being written.
        """
        if not self._thread.is_idle:
            return False
        self._thread.wait()
        return self._unnamed is not None

    def begin(
        self,
        meta: CheckpointMeta,
        learner_state: PyTree,
        env_state: PyTree | None,
        save_more: Callable[[Any], None] = lambda _: None,
    ) -> None:
        """Begins to write a checkpoint; both states may be donated after it.

        Args:
          meta: of the checkpoint.
          learner_state: the same on all GMIs; the leader writes it.
          env_state: this GMI's environments, None where it has none.
          save_more: writes what else the leader has for it, given its state on the host.
        """
        self.finish()
        leader_state = on_host(learner_state) if self._is_leader else None
        own_envs = None if env_state is None else on_host(env_state)

        def write() -> None:
            if own_envs is not None:
                save_envs(self._run, meta.env_steps, self._gmi, own_envs)
            if leader_state is not None:
                save_learner(self._run, meta.env_steps, leader_state)
                save_more(leader_state)

        self._unnamed = meta
        self._thread.report(write)

    def name(self) -> None:
        """Gives the checkpoint its name soon: all GMIs have said that their parts are written."""
        meta, self._unnamed = self._unnamed, None
        assert meta is not None
        self._last = self._run.checkpoint(meta.env_steps)
        if self._is_leader:
            self._thread.report(lambda: finish_checkpoint(self._run, meta, self._keep))

    def finish(self) -> Path | None:
        """Returns the last checkpoint's folder when it is there, None before the first one.

        Collective.
        """
        self._thread.wait()
        if self._unnamed is not None:
            self._meet()
            self.name()
            self._thread.wait()
            self._meet()  # Nobody may look for the folder before it has its name.
        return self._last

    def stop(self) -> None:
        """Ends the thread, which may finish what it does. Idempotent."""
        self._thread.stop()

    @property
    def _is_leader(self) -> bool:
        return self._comm.rank == 0

    def _meet(self) -> None:
        """Returns when all GMIs have called it."""
        self._comm.all_gather(np.zeros(1, np.float32))


def _call(work: Callable[[], Any]) -> None:
    work()

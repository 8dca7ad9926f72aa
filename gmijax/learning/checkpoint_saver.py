"""Writes checkpoints beside the training of one or several GMIs, of one or several runs.

A checkpoint takes some tenths of a second, most of it in the file system. So every GMI copies its
part to the host and trains on, while a thread writes it. The leader gives the checkpoint its name
when all parts are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gmijax.collectives.interface import Communicator
from gmijax.learning.checkpoint import finish_checkpoint, save_envs, save_learner, save_replay
from gmijax.learning.report_thread import ReportThread
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.folder import RunPaths
from gmijax.types import PyTree


class CheckpointPart(NamedTuple):
    """What this GMI has for the checkpoint of a run, on the host.

    Attributes:
      run: the run folder.
      meta: of the checkpoint.
      learner_state: the same on all GMIs; None except on the leader, which writes it.
      env_state: this GMI's environments, None where it has none.
      save_more: writes what else the leader has for it, given the learner's state.
      replay: this GMI's experience, None where checkpoints hold none.
    """

    run: RunPaths
    meta: CheckpointMeta
    learner_state: PyTree | None
    env_state: PyTree | None
    save_more: Callable[[Any], None] = lambda _: None
    replay: PyTree | None = None


class CheckpointSaver:
    """The checkpoints of a GMI that trains; all of them make the same calls.

    Args:
      gmi: whose environments these are.
      comm: among the GMIs that train.
      keep: as of `finish_checkpoint`.

    Attributes:
      last_steps: environment steps of the newest checkpoint with a name, None before the first.
    """

    def __init__(self, gmi: int, comm: Communicator, keep: int | None) -> None:
        self._gmi, self._comm, self._keep = gmi, comm, keep
        self._thread = ReportThread(lambda work: work())
        self._unnamed: Sequence[CheckpointPart] = ()
        self.last_steps: int | None = None

    @property
    def is_written(self) -> bool:
        """Whether this GMI's part of a checkpoint that has no name yet is on the disk.

        Raises what has kept it, or the checkpoint before, from being written.
        """
        if not self._thread.is_idle:
            return False
        self._thread.wait()
        return bool(self._unnamed)

    def begin(self, parts: Sequence[CheckpointPart]) -> None:
        """Begins to write a checkpoint of every run."""
        self.finish()

        def write() -> None:
            for part in parts:  # In turn: orbax can block when several threads use it.
                run, env_steps = part.run, part.meta.env_steps
                if part.env_state is not None:
                    save_envs(run, env_steps, self._gmi, part.env_state)
                if part.replay is not None:
                    save_replay(run, env_steps, self._gmi, part.replay)
                if part.learner_state is not None:
                    save_learner(run, env_steps, part.learner_state)
                    part.save_more(part.learner_state)

        self._unnamed = parts
        self._thread.report(write)

    def name(self) -> None:
        """Gives the checkpoints their names soon: all GMIs have reported theirs as written.

        All at once, so that runs that share a program continue from the same step after a fault.
        """
        parts, self._unnamed = self._unnamed, ()
        self.last_steps = parts[0].meta.env_steps
        if self._comm.rank == 0:
            self._thread.report(
                lambda: [finish_checkpoint(run, meta, self._keep) for run, meta, *_ in parts]
            )

    def finish(self) -> None:
        """Returns when the last checkpoint has its name. Collective."""
        self._thread.wait()
        if self._unnamed:
            self._barrier()
            self.name()
            self._thread.wait()
            self._barrier()  # No GMI may look for the folder before it has its name.

    def stop(self) -> None:
        """Ends the thread, which may finish what it does. Idempotent."""
        self._thread.stop()

    def _barrier(self) -> None:
        self._comm.all_gather(np.zeros(1, np.float32))

"""Backend `share`: several processes on a GPU that take turns, as the driver does by default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from gmijax.partition.backends.guarded import GuardedBackend
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.rundir import RunPaths


class ShareBackend(GuardedBackend):
    """Keeps GMIs away from any MPS daemon that happens to run on the machine."""

    def __init__(self, plan: Plan, machine: Machine, run: RunPaths) -> None:
        del plan, machine
        super().__init__(run)
        self._no_daemon = run.mps / "none"

    def __enter__(self) -> Self:
        """Makes the directory without a daemon."""
        # CUDA takes a directory without a daemon for "no MPS", silently. It is below the run
        # folder because there nobody else can start a daemon in it; as part of that it stays.
        self._no_daemon.mkdir(parents=True, exist_ok=True)
        return super().__enter__()

    def environment(self, gmi: int) -> Mapping[str, str]:
        """Points CUDA at a directory without an MPS daemon."""
        del gmi
        return {"CUDA_MPS_PIPE_DIRECTORY": str(self._no_daemon)}

    def verify(self, pids: Mapping[int, int]) -> None:
        """Nothing to check: memory fractions are kept by XLA."""

    def terminate(self, gmi: int, pid: int) -> None:
        """Nothing to detach."""

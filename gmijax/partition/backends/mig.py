"""Backend `mig`: a GMI lives in a MIG instance, with SMs, cache and memory of its own.

Attaches to the instances that an administrator has made, and never changes a GPU's mode. GMIs
that share an instance run at the same time under MPS daemons of the job's own, one an instance.

MIG reference: https://docs.nvidia.com/datacenter/tesla/mig-user-guide/.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any, Self

from gmijax.errors import BackendUnavailable
from gmijax.partition.backends.mps import MpsBackend
from gmijax.partition.backends.share import ShareBackend
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.rundir import RunPaths


class MigBackend:
    """Keeps GMIs in their instances; CUDA sees nothing but what `CUDA_VISIBLE_DEVICES` names.

    Args:
      plan: its slices name the instances.
      machine: the instances that exist now.
      run: logs of MPS daemons go below its `mps` folder.

    Raises:
      BackendUnavailable: an instance of the plan does not exist (any more), or MPS, to share
        one, is not installed.
    """

    def __init__(self, plan: Plan, machine: Machine, run: RunPaths) -> None:
        existing = {one.uuid for gpu in machine.gpus for one in gpu.instances}
        for share in plan.slices:
            if share.device not in existing:
                raise BackendUnavailable(
                    f"plan.backend=mig: instance {share.device} of GMI {share.gmi} does not exist"
                )
        sharing = Counter(share.device for share in plan.slices)
        self._crowded = {share.gmi for share in plan.slices if sharing[share.device] > 1}
        self._alone = ShareBackend(plan, machine, run)
        self._mps: MpsBackend | None = None
        if self._crowded:
            # A daemon of somebody else is for other devices than the job's instances.
            own_only = dataclasses.replace(machine, operator_daemon=None)
            self._mps = MpsBackend(plan, own_only, run, self._crowded)

    def __enter__(self) -> Self:
        """Starts a daemon for every instance that several GMIs share."""
        self._alone.__enter__()
        try:
            if self._mps is not None:
                self._mps.__enter__()
        except BaseException:
            self._alone.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exc: Any) -> None:
        """Quits these daemons; the instances stay as they were."""
        if self._mps is not None:
            self._mps.__exit__(*exc)
        self._alone.__exit__(*exc)

    def environment(self, gmi: int) -> Mapping[str, str]:
        """Where the GMI's daemon listens, or a place where none does."""
        daemons = self._daemons_of(gmi)
        return self._alone.environment(gmi) if daemons is None else daemons.environment(gmi)

    def started(self, gmi: int, pid: int) -> None:
        """Tells the janitors: that of the daemons waits for its clients before it ends them."""
        self._alone.started(gmi, pid)
        if self._mps is not None:
            self._mps.started(gmi, pid)

    def verify(self, pids: Mapping[int, int]) -> None:
        """Checks that GMIs that share an instance are clients of its daemon."""
        if self._mps is not None:
            self._mps.verify({gmi: pid for gmi, pid in pids.items() if gmi in self._crowded})

    def terminate(self, gmi: int, pid: int) -> None:
        """Takes the GMI off its daemon, if it has one."""
        daemons = self._daemons_of(gmi)
        if daemons is not None:
            daemons.terminate(gmi, pid)

    def _daemons_of(self, gmi: int) -> MpsBackend | None:
        return self._mps if gmi in self._crowded else None

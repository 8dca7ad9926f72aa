"""Backend `mig`: a GMI lives in a MIG instance, with SMs, cache and memory of its own.

Attaches to the instances that an administrator has made, and never changes a GPU's mode. GMIs
that share an instance run at the same time under MPS daemons of the job's own, one an instance.

MIG reference: https://docs.nvidia.com/datacenter/tesla/mig-user-guide/.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping

from gmijax.errors import BackendUnavailable
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.mps import MpsBackend
from gmijax.supervise.backends.share import no_daemon


class MigBackend(MpsBackend):
    """Keeps GMIs in their instances; CUDA sees nothing but what `CUDA_VISIBLE_DEVICES` names.

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
        clients = [share.gmi for share in plan.slices if sharing[share.device] > 1]
        # A daemon of somebody else is for other devices than the job's instances.
        own_only = dataclasses.replace(machine, operator_daemon=None)
        super().__init__(plan, own_only, run, clients)

    def environment(self, gmi: int) -> Mapping[str, str]:
        """Where the GMI's daemon listens, or a place where none does."""
        return super().environment(gmi) if self.is_client(gmi) else no_daemon(self.run)

"""Backend `cpu`: GPUs are virtual, a GMI is a process with CPU cores of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import metadata

from gmijax.partition.backends.guarded import GuardedBackend
from gmijax.partition.machine import Machine
from gmijax.partition.plan import Plan
from gmijax.rundir import RunPaths

NO_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
"""Physics of long kinematic chains runs up to a thousand times slower with the emitters."""

_FIRST_JAXLIB_WITHOUT_FLAG = (0, 11, 1)
"""From here on XLA ends the process when it meets the flag, as with any unknown one."""


class CpuBackend(GuardedBackend):
    """Nothing to set up: the cores are part of the plan, GMIs pin themselves to them."""

    def __init__(self, plan: Plan, machine: Machine, run: RunPaths) -> None:
        del plan, machine
        super().__init__(run)

    def environment(self, gmi: int) -> Mapping[str, str]:
        """XLA flags that the installed jaxlib understands."""
        del gmi
        return cpu_environment(_jaxlib_version())

    def verify(self, pids: Mapping[int, int]) -> None:
        """Nothing can be missing."""

    def terminate(self, gmi: int, pid: int) -> None:
        """Nothing to detach."""


def cpu_environment(jaxlib: tuple[int, ...] | None) -> dict[str, str]:
    """The variables for a jaxlib version; none where jaxlib is not installed."""
    accepted = jaxlib is not None and jaxlib < _FIRST_JAXLIB_WITHOUT_FLAG
    return {"XLA_FLAGS": NO_FUSION_EMITTERS} if accepted else {}


def _jaxlib_version() -> tuple[int, ...] | None:
    # Read from the package's metadata: the controller must not import jax.
    try:
        version = metadata.version("jaxlib")
    except metadata.PackageNotFoundError:
        return None
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])

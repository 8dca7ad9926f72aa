"""Ways to give a GMI its share of a GPU. A new one is a class and one line in `BACKENDS`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

from gmijax.config import BackendName
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.backends.mps import MigBackend, MpsBackend, ShareBackend

BACKENDS: Mapping[BackendName, type[Backend]] = MappingProxyType(
    {"mps": MpsBackend, "mig": MigBackend, "share": ShareBackend, "cpu": Backend}
)


def open_backend(
    plan: Plan, machine: Machine, run: RunPaths, gmis: Collection[int] | None = None
) -> Backend:
    """The backend of a plan, to be entered with `with`.

    Args:
      plan: what is to be enforced.
      machine: this one.
      run: where logs go.
      gmis: those of this machine; None: all of the plan.

    Raises:
      BackendUnavailable: it cannot be had on this machine.
    """
    return BACKENDS[plan.backend](plan, machine, run, gmis)

"""The seam between the supervisor and the ways to give a GMI its share of a GPU."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Self

from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.janitor import JanitorLink


class Backend:
    """Enforces the shares of a plan while it is entered; leaving it undoes what it did.

    This one, for `cpu`, enforces nothing: GMIs pin themselves to their cores. It starts the
    janitor, which ends the GMIs if the controller is killed. Leave it after every GMI has ended.

    Raises:
      BackendUnavailable: it cannot be had on this machine; nothing is left behind.
    """

    def __init__(
        self, plan: Plan, machine: Machine, run: RunPaths, gmis: Collection[int] | None = None
    ) -> None:
        del machine, gmis
        self.plan = plan
        self.run = run
        self._janitor: JanitorLink | None = None

    def __enter__(self) -> Self:
        """Sets up what the GMIs need."""
        self._janitor = JanitorLink(self.run.janitor_log)
        return self

    def __exit__(self, *exc: Any) -> None:
        """Takes down what `__enter__` set up, and nothing else."""
        if self._janitor is not None:
            self._janitor.dismiss()
            self._janitor = None

    @property
    def daemons(self) -> Mapping[str, Path]:
        """Pipe directories of the daemons in use, by UUID of the GPU or MIG instance."""
        return {}

    def environment(self, gmi: int) -> Mapping[str, str]:
        """The backend's own environment variables of a GMI."""
        del gmi
        return {}

    def renew(self, gmi: int) -> None:
        """Before a GMI starts later than others: restores what it needs and has died meanwhile.

        Raises:
          BackendUnavailable: that cannot be done.
        """

    def started(self, pid: int, group: int | None = None) -> None:
        """Records that a GMI runs as the process group `pid`.

        Of a `group` whose leader has ended it gets the other members.
        """
        if self._janitor is not None:
            self._janitor.watch_gmi(pid, group)

    def verify(self, pids: Mapping[int, int]) -> None:
        """Checks that every GMI really has its share; `pids` is GMI -> process.

        Raises:
          GmiFailed: a GMI runs without it, or that cannot be found out.
        """

    def terminate(self, gmi: int, pids: Collection[int]) -> None:
        """Detaches a GMI's processes from its GPU before they are killed.

        Best effort, returns in seconds.
        """

    def why_no_client(self, gmi: int, pids: Collection[int]) -> str | None:
        """Why none of these processes has the share of a GMI; None: one has, or needs none."""
        del gmi, pids
        return None

"""Backends of GPUs: GMIs run at the same time under NVIDIA's Multi-Process Service, or do not.

One daemon per GPU (or shared MIG instance), with a pipe directory of its own: a fatal fault of one
client ends every client of its server, so GPUs must not share a server. A daemon that gmijax has
not started is used and never stopped.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from gmijax.clock import running_s
from gmijax.errors import BackendUnavailable, GmiFailed
from gmijax.machine.mps_control import PIPE_VARIABLE, MpsControl
from gmijax.machine.snapshot import Machine
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends.backend import Backend
from gmijax.supervise.janitor import quit_daemon

_ANSWER_S = 10.0
_CLIENTS_LEAVE_S = 5.0
_CLIENTS_APPEAR_S = 3.0
_POLL_S = 0.1

# A pipe directory holds sockets, whose paths may have 107 characters.
_LONGEST_PARENT = 60


class MpsBackend(Backend):
    """Runs the daemons of a job while it is entered.

    Args:
      plan: its allocations name the devices.
      machine: where the control program is, and whether a daemon runs already.
      run: logs go below its `mps` folder.
      gmis: those that are clients of a daemon; None for all.

    Raises:
      BackendUnavailable: the control program is not installed.
    """

    def __init__(
        self, plan: Plan, machine: Machine, run: RunPaths, gmis: Collection[int] | None = None
    ) -> None:
        super().__init__(plan, machine, run)
        gmis = plan.layout.gmis if gmis is None else gmis
        self._devices = {gmi: plan.allocations[gmi].device for gmi in gmis}
        if machine.mps_control is None and self._devices:
            raise BackendUnavailable(
                f"plan.backend={plan.backend}: nvidia-cuda-mps-control was not found"
            )
        self._program = machine.mps_control or Path()
        # Daemons that this job did not start, and those that it does.
        self._existing = {
            device: MpsControl(self._program, pipe)
            for device in self._devices.values()
            if (pipe := machine.daemon_of(device)) is not None
        }
        self._own: dict[str, MpsControl] = {}
        self._unresponsive: set[str] = set()

    def __enter__(self) -> Self:
        """Starts a daemon per GPU, or attaches to the one that runs."""
        super().__enter__()
        try:
            for device in dict.fromkeys(self._devices.values()):
                if device not in self._existing:
                    self._start_daemon(device)
        except BaseException:
            self._quit_all()
            super().__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *exc: Any) -> None:
        """Quits the own daemons once their clients have left."""
        deadline_s = running_s() + _CLIENTS_LEAVE_S
        for control in self._own.values():
            with suppress(BackendUnavailable):
                while control.all_client_pids() and running_s() < deadline_s:
                    time.sleep(_POLL_S)
        self._quit_all()
        super().__exit__(*exc)

    @property
    def daemons(self) -> Mapping[str, Path]:
        """See `Backend`."""
        used = self._existing | self._own
        return {device: control.pipe_directory for device, control in used.items()}

    def environment(self, gmi: int) -> Mapping[str, str]:
        """Where the GMI's daemon listens, or a directory where none does.

        CUDA takes the latter for "no MPS", silently. It is below the run folder because there
        no other user can start a daemon in it.
        """
        if gmi in self._devices:
            return {PIPE_VARIABLE: str(self._control_of(gmi).pipe_directory)}
        directory = self.run.mps / "none"
        directory.mkdir(parents=True, exist_ok=True)
        return {PIPE_VARIABLE: str(directory)}

    def renew(self, gmi: int) -> None:
        """Starts the GMI's daemon anew if it is an own one that no longer answers."""
        device = self._devices.get(gmi)
        if device in self._own and not self._own[device].is_answering():
            quit_daemon(self._own[device])
            self._start_daemon(device)
        # An existing one may have been restarted too: it is asked once more for each new GMI.
        self._unresponsive -= {device}

    def verify(self, pids: Mapping[int, int]) -> None:
        """Checks with the daemons that every GMI that is to be a client is one.

        CUDA falls back to time slicing, silently, when it does not reach the daemon.
        """
        deadline_s = running_s() + _CLIENTS_APPEAR_S
        while non_clients := self._non_clients(pids):
            if running_s() > deadline_s:
                gmi, pid = next(iter(non_clients.items()))
                raise GmiFailed(
                    gmi,
                    f"its process {pid} is not a client of the MPS daemon in "
                    f"{self._control_of(gmi).pipe_directory}; {self._advice(gmi)}",
                )
            time.sleep(_POLL_S)

    def terminate(self, gmi: int, pids: Collection[int]) -> None:
        """See `Backend`: killing a client that is busy can fault its neighbours."""
        device = self._devices.get(gmi)
        if device is None or device in self._unresponsive:
            return
        control = self._control_of(gmi)
        try:
            for client, server in control.all_client_pids().items():
                if client in pids:
                    control.terminate_client(server, client)
        except BackendUnavailable:
            # Each attempt could cost a time limit; the other GMIs are killed without it.
            self._unresponsive.add(device)

    def why_no_client(self, gmi: int, pids: Collection[int]) -> str | None:
        """See `Backend`."""
        if gmi not in self._devices:
            return None
        try:
            if set(pids) & self._control_of(gmi).all_client_pids().keys():
                return None
        except BackendUnavailable as error:
            return str(error)
        pipe = self._control_of(gmi).pipe_directory
        return f"no process of it is a client of the MPS daemon in {pipe}; {self._advice(gmi)}"

    def _control_of(self, gmi: int) -> MpsControl:
        device = self._devices[gmi]
        return self._own.get(device) or self._existing[device]

    def _start_daemon(self, device: str) -> None:
        index = list(dict.fromkeys(self._devices.values())).index(device)
        log_directory = self.run.mps / f"gpu_{index}"
        parent = tempfile.gettempdir()
        parent = parent if len(parent) <= _LONGEST_PARENT else "/tmp"
        # mkdtemp makes it readable for this user only.
        control = MpsControl(self._program, Path(tempfile.mkdtemp(prefix="gmijax-", dir=parent)))
        self._own[device] = control
        if self._janitor is not None:
            self._janitor.watch_daemon(control)
        control.start(device, log_directory)
        deadline_s = running_s() + _ANSWER_S
        while not control.is_answering():
            if running_s() > deadline_s:
                raise BackendUnavailable(
                    f"plan.backend={self.plan.backend}: the daemon of {device} does not answer "
                    f"within {_ANSWER_S:g} s; see {log_directory}"
                )
            time.sleep(_POLL_S)

    def _non_clients(self, pids: Mapping[int, int]) -> dict[int, int]:
        """Those of the GMIs that are to be clients and are not."""
        clients: dict[MpsControl, Mapping[int, int]] = {}
        non_clients: dict[int, int] = {}
        for gmi, pid in pids.items():
            if gmi not in self._devices:
                continue
            control = self._control_of(gmi)
            try:
                if control not in clients:
                    clients[control] = control.all_client_pids()
            except BackendUnavailable as error:
                raise GmiFailed(gmi, f"cannot ask whether it is an MPS client: {error}") from error
            if pid not in clients[control]:
                non_clients[gmi] = pid
        return non_clients

    def _advice(self, gmi: int) -> str:
        if self._devices[gmi] not in self._existing:
            return f"see its logs in {self.run.mps}, or use plan.backend=share"
        return (
            "gmijax did not start this daemon: if it runs in another PID namespace (outside of "
            "this container), it knows its clients by other numbers and they cannot be checked; "
            "share its PID namespace, or use plan.backend=share"
        )

    def _quit_all(self) -> None:
        try:
            for control in self._own.values():
                quit_daemon(control)
        except BaseException:  # Ctrl-C in a process that lives on.
            if self._janitor is not None:
                self._janitor.take_over()
            raise
        self._own = {}


class MigBackend(MpsBackend):
    """A GMI lives in a MIG instance, with SMs, cache and memory of its own.

    Attaches to the instances that an administrator has made, and never changes a GPU's mode. GMIs
    that share an instance run at the same time under a daemon of the job's own.
    https://docs.nvidia.com/datacenter/tesla/mig-user-guide/

    Raises:
      BackendUnavailable: an instance of the plan does not exist (any more), or MPS, to share
        one, is not installed.
    """

    def __init__(
        self, plan: Plan, machine: Machine, run: RunPaths, gmis: Collection[int] | None = None
    ) -> None:
        existing = {one.uuid for gpu in machine.gpus for one in gpu.instances}
        here = [plan.allocations[gmi] for gmi in (plan.layout.gmis if gmis is None else gmis)]
        for allocation in here:
            if allocation.device not in existing:
                raise BackendUnavailable(
                    f"plan.backend=mig: instance {allocation.device} of GMI {allocation.gmi} "
                    "does not exist"
                )
        sharing = Counter(allocation.device for allocation in plan.allocations)
        clients = [
            allocation.gmi
            for allocation in here
            if sharing[allocation.device] > 1 or allocation.device in machine.daemons
        ]
        # An existing daemon is for other devices than the job's instances.
        own_only = dataclasses.replace(machine, operator_daemon=None)
        super().__init__(plan, own_only, run, clients)


class ShareBackend(MpsBackend):
    """GMIs of a GPU take turns, as the driver does by default, away from any MPS daemon."""

    def __init__(
        self, plan: Plan, machine: Machine, run: RunPaths, gmis: Collection[int] | None = None
    ) -> None:
        del gmis
        super().__init__(plan, machine, run, gmis=())

"""A machine that runs jobs of a sweep: what the scheduler asks of it, and this machine itself."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, NamedTuple

from gmijax.machine.mps_control import MEMORY_LIMIT_VARIABLE, PIPE_VARIABLE
from gmijax.machine.nvidia import GpuLoad, load_of
from gmijax.machine.processes import ProcessId, started_by
from gmijax.machine.snapshot import DAEMONS_VARIABLE, Machine
from gmijax.partition.plan import Plan
from gmijax.runs.cache import cache_folder
from gmijax.runs.folder import RunPaths
from gmijax.runs.held import try_lock
from gmijax.supervise.backends import open_backend
from gmijax.supervise.backends.backend import Backend
from gmijax.sweeps.children import Child, ChildStatus, Process
from gmijax.sweeps.slots import Slot

Order = Literal["ask_to_stop", "interrupt", "kill", "close"]


class ChildStart(NamedTuple):
    """What is to be started where; see `Process`."""

    slot: Slot
    process: Process


class LocalHost:
    """This machine.

    Attributes:
      name: address of a node; None: this machine.
      machine: what it has.
      lost: why it is gone; None while it answers.
      left: processes of jobs that could not be ended, each with the lock of its job.
    """

    name: str | None = None
    lost: str | None = None

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.left: list[tuple[Path, ProcessId]] = []
        self._leases, self._entered = ExitStack(), ExitStack()
        self._backend: Backend | None = None
        self._children: dict[int, Child] = {}
        self._clients: dict[int, int] = {}
        self._num_started = 0

    def lease(self, devices: Iterable[str]) -> str | None:
        """Holds all devices until `close`; if another sweep has any, its UUID, and holds none."""
        folder = cache_folder() / "leases"
        with ExitStack() as taken:
            for device in set(devices):
                folder.mkdir(parents=True, exist_ok=True)
                if (fd := try_lock(folder / f"{device}.lock")) is None:
                    return device
                taken.callback(os.close, fd)
            self._leases.push(taken.pop_all())
        return None

    def open(self, plan: Plan, run: RunPaths) -> None:
        """Enters the backend of a plan of slots.

        Raises:
          BackendUnavailable: it cannot be had there.
        """
        self._backend = self._entered.enter_context(open_backend(plan, self.machine, run))

    def start(self, start: ChildStart) -> int:
        """Starts jobs; the number of their process on this machine, new for each start.

        Raises:
          GmijaxError: it cannot be started, or its daemon not be renewed.
        """
        assert self._backend is not None
        variables = (
            client_variables(start.slot, start.process, self._backend, self.machine)
            if start.process.is_client
            else variables_of(start.slot, self._backend)
        )
        child = Child(start.process, variables)
        self._backend.started(child.pid)
        self._num_started += 1
        self._children[self._num_started] = child
        if start.process.is_client:
            self._clients[self._num_started] = start.slot.allocations[0].gmi
        return self._num_started

    def look(self, child: int) -> ChildStatus | None:
        """The newest that is known of a child, None before anything is."""
        return self._look(self._children[child])

    def look_at_all(self) -> dict[int, ChildStatus]:
        """How all children are that are not closed."""
        return {number: self._look(child) for number, child in self._children.items()}

    def _look(self, child: Child) -> ChildStatus:
        before, status = child.rest, child.look()
        if self._backend is not None:
            for process in set(child.rest).difference(before):
                self._backend.started(process.pid, child.pid)
        return status

    def order(self, child: int, order: Order) -> None:
        """Calls a method of a child."""
        # Killing a client that is busy can harm its neighbours.
        is_killing = order in ("kill", "close") and child in self._clients
        if is_killing and self._backend is not None:
            self._backend.terminate(self._clients[child], self._pids_of(child))
        getattr(self._children[child], order)()
        if order == "close":
            closed = self._children.pop(child)
            if closed.lock is not None:
                self.left += [(closed.lock, process) for process in closed.left]
            self._clients.pop(child, None)

    def why_no_client(self, child: int) -> str | None:
        """Why a child has no share of its GPU, though its daemon should give it one; None: it has.

        Asked of those that use the GPU themselves, once they do.
        """
        if self._backend is None or child not in self._clients:
            return None
        return self._backend.why_no_client(self._clients[child], self._pids_of(child))

    def _pids_of(self, child: int) -> list[int]:
        """All that it has started, and itself."""
        return [process.pid for process in started_by(self._children[child].pid)]

    def load_of(self, device: str) -> GpuLoad | None:
        """What a GPU does at the moment."""
        return load_of(device)

    def shut(self) -> None:
        """Leaves the backend; all children have ended."""
        self._backend = None
        self._entered.close()

    def close(self) -> None:
        """Ends what is left, and gives back all."""
        for order in ("kill", "close"):  # So that they end at the same time.
            for number in list(self._children):
                self.order(number, order)
        self.shut()
        self._leases.close()


def variables_of(slot: Slot, backend: Backend) -> dict[str, str]:
    """Variables of a job at a slot: its GPUs, and the daemon of each; a dead one is renewed."""
    if not slot.devices:
        return {}
    daemons: dict[str, str] = {}
    for allocation in slot.allocations:
        backend.renew(allocation.gmi)
        if pipe := backend.environment(allocation.gmi).get(PIPE_VARIABLE):
            daemons[allocation.device] = pipe
    devices = ",".join(slot.devices)
    return {"CUDA_VISIBLE_DEVICES": devices, DAEMONS_VARIABLE: json.dumps(daemons)}


def client_variables(
    slot: Slot, process: Process, backend: Backend, machine: Machine
) -> dict[str, str]:
    """Variables of a program of any kind: its GPU, and its share; a dead daemon is renewed."""
    if not slot.devices:
        return {}
    allocation, device = slot.allocations[0], slot.devices[0]
    backend.renew(allocation.gmi)
    variables = dict(backend.environment(allocation.gmi))
    # Many programs take numbers alone. Of a daemon of our own, which has one GPU, it is the first.
    gpu = next((gpu for gpu in machine.gpus if gpu.uuid == device), None)
    if slot.backend == "mps" and device in backend.daemons and machine.daemon_of(device) is None:
        variables["CUDA_VISIBLE_DEVICES"] = "0"
    else:
        variables["CUDA_DEVICE_ORDER"] = "PCI_BUS_ID"
        variables["CUDA_VISIBLE_DEVICES"] = device if gpu is None else str(gpu.index)
    if pipe := backend.daemons.get(device):
        # gmijax in a job of a pack takes its GPU's UUID from it, and is an MPS client.
        variables[DAEMONS_VARIABLE] = json.dumps({device: str(pipe)})
    if slot.backend == "mps" and process.memory_fraction is not None and gpu is not None:
        variables[MEMORY_LIMIT_VARIABLE] = f"0={int(process.memory_fraction * gpu.memory_mib)}M"
    return variables

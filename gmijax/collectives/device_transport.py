"""Runs the stages of a reduction on a GPU's stream: by shared GPU memory, NCCL rings or the host.

Slots and rings do not stop the host: copies, a flag for the others, waits for their flags and a
copy of what they wrote are queued on the program's stream, between its other work.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gmijax.collectives.all_or_none import Group, all_or_none, warn_of
from gmijax.collectives.device.device_memory import NewMemory
from gmijax.collectives.device.ipc_buffers import IpcBuffers
from gmijax.collectives.device.lockstep import LockstepRunner
from gmijax.collectives.device.nccl_ring import NcclRing
from gmijax.collectives.host_transport import HostTransport
from gmijax.collectives.shared_memory import Fence
from gmijax.collectives.strategies import Groups, ReductionStage
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import leaders

if TYPE_CHECKING:
    from gmijax.collectives.device.cuda_queue import CudaQueue

T = TypeVar("T")

_FREE = 2**30
_FEATURE = "exchange on the device's stream"


class DesyncDetector:
    """Detects ranks that call different collectives, or in another order, without waiting.

    Flags only count. Beside its flag each rank keeps the number of exchanges that it has reached,
    and a checksum of which ones these were, in their order. It compares the checksums of ranks
    with the same number. Checksums never agree again once they differ, and the last rank to
    finish a step sees those of all others: so one of two ranks notices before the next step,
    whichever is ahead.

    It uses the second 64 bits of each line of `flags`, see `SharedBlock`.
    """

    def __init__(self, flags: npt.NDArray[np.uint32], rank: int, world_size: int) -> None:
        self._words = flags.view(np.uint64)[:world_size, 1]
        self._rank = rank
        self._fence = Fence()
        self._count = self._checksum = 0
        self._words[rank] = 0

    def record(self, call_index: int, num_floats: int) -> int | None:
        """Records the next exchange; returns a rank that has reached another one instead."""
        self._count += 1
        which = call_index.to_bytes(8, "little") + num_floats.to_bytes(8, "little")
        self._checksum = zlib.crc32(which, self._checksum)
        own = (self._count & 0xFFFFFFFF) << 32 | self._checksum
        self._words[self._rank] = own
        self._fence()  # Of two that come at the same time one sees the other.
        for peer, word in enumerate(self._words.tolist()):
            if word != own and word >> 32 == own >> 32:
                return peer
        return None


class Device(NamedTuple):
    """What the transport of a device is made of.

    Attributes:
      new_memory: makes or opens memory that processes share.
      new_queue: adds work to streams, with flags [whole pages, line].
      new_ring: makes this rank's ring, from groups of ranks; all ranks of the job call it, and
        get None if they are in none of the groups. None itself where rings go through the host.
    """

    new_memory: NewMemory
    new_queue: Callable[[npt.NDArray[np.uint32]], CudaQueue]
    new_ring: Callable[[Group, Groups], NcclRing | None] | None


class DeviceTransport(HostTransport):
    """Moves numbers on the device's stream; all ranks of the job make theirs together.

    Stages through the host and sockets go the way of `HostTransport`, as do rings on a CPU. Shared
    memory of devices is of one node, by ranks in the node; rings may go over several.

    Args:
      control: this rank's use of the shared block from outside of programs.
      host: the same from within them, with the flags.
      layout: where all ranks live.
      num_floats: P, length of the largest buffer.
      stages: of the strategy.
      device: what they are made of.

    Raises:
      DeviceMemoryUnavailable: it does not work here; on all ranks alike.
      PeerLost, CollectiveTimeout: as in the first call of a communicator.
    """

    def __init__(
        self,
        control: Group,
        host: Group,
        layout: Layout,
        num_floats: int,
        stages: Sequence[ReductionStage],
        device: Device,
    ) -> None:
        super().__init__(host, num_floats)
        self._control, self._here = control, control.local
        self._device = device
        self._runner = LockstepRunner(control, num_floats)
        self._queue: CudaQueue | None = None
        self._desync: DesyncDetector | None = None
        self._ipc: IpcBuffers | None = None
        self._rings: dict[Groups, NcclRing | None] = {}
        try:
            if any(stage.transport == "ipc" for stage in stages):
                self._ipc = self._new_ipc(layout, stages, device.new_memory)
            if (new_ring := device.new_ring) is not None:
                rings = {stage.groups for stage in stages if stage.transport == "ring"}
                for groups in sorted(rings):  # One by one: those before one that fails are closed.
                    self._rings[groups] = new_ring(control, groups)
        except BaseException:
            self.close()
            raise

    def _new_ipc(
        self, layout: Layout, stages: Sequence[ReductionStage], new_memory: NewMemory
    ) -> IpcBuffers:
        rank, layout = self._here.rank, layout.of_node(0)
        groups = next(stage.groups for stage in stages if stage.transport == "ipc")
        group = next(group for group in self._control.of_node(groups) if rank in group)
        owners = group[:1]
        if len(group) == layout.num_gmis:
            # On every GPU: the own first, then the following ones, so that not all write to one.
            first, near = leaders(layout), layout.gpu_of(rank)
            owners = first[near:] + first[:near]
        return IpcBuffers(self._control, self.capacity, group, owners, new_memory, _FEATURE)

    def start(self, checks: Sequence[Callable[[], bool]]) -> None:
        """See `HostTransport`."""
        all_or_none(self._control, _FEATURE, self._open)
        for check in checks:
            failure = self._runner.finish(partial(self._try, check))
            all_or_none(self._control, _FEATURE, partial(_raise, failure))
        self.exchange_s()  # Not a part of the first step.

    def reduce(
        self,
        stage: ReductionStage,
        stream: int,
        call_index: int,
        source: int,
        target: int,
        num_floats: int,
    ) -> None:
        """See `HostTransport`."""
        most = max(len(group) for group in stage.groups)
        if stage.transport == "ipc" and self._ipc is not None:
            with self._exchanging(stream, call_index, num_floats) as queue:
                if stage.kind == "all_gather":
                    self._ipc.all_gather(queue, stream, source, target, num_floats, rows=most)
                else:
                    assert stage.kind == "broadcast"  # Slots add nothing up.
                    self._ipc.broadcast(queue, stream, source, target, num_floats)
        elif stage.transport == "ring" and stage.groups in self._rings:
            with self._exchanging(stream, call_index, num_floats) as queue:
                ring = self._rings[stage.groups]
                if ring is None:
                    queue.copy(stream, target, source, 4 * num_floats)
                else:
                    getattr(ring, stage.kind)(stream, source, target, num_floats)
        else:
            super().reduce(stage, stream, call_index, source, target, num_floats)

    def run(self, program: Callable[[], T], *, is_last: bool) -> T:
        """See `HostTransport`."""
        run = self._runner.finish if is_last else self._runner.step
        return run(lambda: self._explained(program))

    def exchange_s(self) -> float:
        """See `HostTransport`: each from the time that this rank's numbers were there."""
        on_device_s = 0.0 if self._queue is None else self._queue.clocked_s()
        return super().exchange_s() + on_device_s

    def close(self) -> None:
        """See `HostTransport`; what a device may still be at stays until the process ends."""
        if self._runner.is_caught:
            return
        self._runner.close()
        for held in (self._queue, *self._rings.values(), self._ipc):
            if held is not None:
                held.close()
        self._queue, self._desync, self._ipc, self._rings = None, None, None, {}
        super().close()

    @contextmanager
    def _exchanging(self, stream: int, call_index: int, num_floats: int) -> Iterator[CudaQueue]:
        """Counts the time, and checks that other ranks are at the same exchange."""
        if self._queue is None or self._desync is None:
            raise RuntimeError("the exchange is closed")
        if (peer := self._desync.record(call_index, num_floats)) is not None:
            gmi, other = (self._here.ids[rank] for rank in (self._here.rank, peer))
            raise RuntimeError(
                f"GMI {gmi} and GMI {other} call their exchanges in different orders; "
                f"here it is number {call_index} of its program, with {num_floats} floats"
            )
        self._queue.start_clock(stream)
        yield self._queue
        self._queue.stop_clock(stream)

    def _open(self) -> bytes:
        here = self._here
        # Counted from here on, also after an attempt with more in it that did not work.
        here.flags[here.rank, 0] = 0
        self._queue = self._device.new_queue(here.flags)
        self._desync = DesyncDetector(here.flags, here.rank, here.world_size)
        return b""

    def _try(self, check: Callable[[], bool]) -> Exception | None:
        """Runs the check; what went wrong with it."""
        flags = self._here.flags
        try:
            if not check() and not (flags[:, 0] == _FREE).any():
                raise RuntimeError("shared GPU memory does not hold what was written into it")
        except Exception as error:  # Whatever it is, the host can take part instead.
            flags[self._here.rank, 0] = _FREE  # The others' devices wait for it.
            warn_of(_FEATURE, error)
            return error
        return None


def _raise(failure: Exception | None) -> bytes:
    if failure is not None:
        raise failure
    return b""

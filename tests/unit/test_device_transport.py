"""The transport of a device, with what is not a GPU's: attempts that do not work."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TypeAlias

import pytest
from fake_device_memory import FAKES
from shared_ranks import host_ranks

from gmijax.collectives.all_or_none import Group
from gmijax.collectives.device import nccl_ring as rings
from gmijax.collectives.device.nccl_ring import NcclRing, nccl_ring
from gmijax.collectives.device_transport import DeviceTransport
from gmijax.collectives.host.shared_block import LANES, create_exchange
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.strategies import Groups, ReductionStage, stages
from gmijax.errors import DeviceMemoryUnavailable
from gmijax.partition.layout import Layout

SIZE = 5

NewTransport: TypeAlias = Callable[[], DeviceTransport]


@pytest.fixture
def new_transport() -> Iterator[NewTransport]:
    """Makes the transport of the only rank, each time over the same shared block."""
    fd, layout = create_exchange(), Layout.even(1, 1)
    times = {"timeout_s": 20.0, "rendezvous_timeout_s": 20.0}
    control, host = (SharedMemoryGroup(fd, 0, 1, SIZE, lane=k, **times) for k in range(LANES))
    os.close(fd)
    parts = stages("one_shot", layout, "ipc")
    yield lambda: DeviceTransport(control, host, layout, SIZE, parts, FAKES["fake"])
    host.close()
    control.close()


class RecordingNccl:
    """NCCL of which the last member of a ring cannot join; communicators are numbers of members.

    Attributes:
      given_back: how each communicator was.
    """

    DataType, RedOp = SimpleNamespace(Float32=7), SimpleNamespace(Sum=0)
    UniqueId = SimpleNamespace(from_buffer=bytes)

    def __init__(self) -> None:
        self.given_back: list[tuple[str, int]] = []

    def get_unique_id(self) -> bytes:
        return b"id"

    def comm_init_rank(self, size: int, unique: bytes, rank: int) -> int:
        if rank == size - 1:
            raise RuntimeError("ncclSystemError")
        return rank

    def comm_destroy(self, comm: int) -> None:
        self.given_back.append(("destroyed", comm))
        raise RuntimeError("ncclRemoteError")

    def comm_abort(self, comm: int) -> None:
        self.given_back.append(("aborted", comm))
        raise RuntimeError("ncclRemoteError")


def test_who_has_joined_a_ring_that_another_cannot_join_gives_it_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nccl = RecordingNccl()
    monkeypatch.setattr(rings, "_nccl", lambda: nccl)

    def come(rank: SharedMemoryGroup) -> None:
        with pytest.raises(DeviceMemoryUnavailable, match=r"rings .* GMI 2: ncclSystemError"):
            nccl_ring(rank, ((0, 1, 2),))

    message = "rings between GPUs: ncclSystemError"
    with pytest.warns(RuntimeWarning, match=message), ThreadPoolExecutor(3) as pool:
        list(pool.map(come, host_ranks(SIZE, SIZE, SIZE)))
    assert sorted(nccl.given_back) == [("aborted", 0), ("aborted", 1)]


def test_a_ring_is_given_back_once_whatever_nccl_says_of_it() -> None:
    nccl = RecordingNccl()
    ring, given_up = NcclRing(nccl, 0), NcclRing(nccl, 1)
    ring.close()
    ring.close()
    try:
        raise ValueError
    except ValueError:
        given_up.close()
    given_up.close()
    assert nccl.given_back == [("destroyed", 0), ("aborted", 1)]


def test_rings_made_before_one_that_fails_are_given_back() -> None:
    nccl = RecordingNccl()

    def new_ring(group: Group, groups: Groups) -> NcclRing:
        del group
        if len(groups) == 2:
            raise DeviceMemoryUnavailable("no second one")
        return NcclRing(nccl, 0)

    (rank,) = host_ranks(SIZE)
    parts = [ReductionStage("all_reduce", "ring", groups) for groups in (((0,),), ((0,), (1,)))]
    device = FAKES["fake"]._replace(new_ring=new_ring)
    with pytest.raises(DeviceMemoryUnavailable, match="no second one"):
        DeviceTransport(rank, rank, Layout.even(1, 1), SIZE, parts, device)
    assert nccl.given_back == [("aborted", 0)]


def test_a_second_attempt_does_not_begin_with_the_flags_of_the_first(
    new_transport: NewTransport,
) -> None:
    def fails() -> bool:
        raise RuntimeError("CUDA_ERROR_INVALID_VALUE")

    first = new_transport()
    with (
        pytest.warns(RuntimeWarning, match="CUDA_ERROR_INVALID_VALUE"),
        pytest.raises(DeviceMemoryUnavailable, match="CUDA_ERROR_INVALID_VALUE"),
    ):
        first.start([fails])
    first.close()
    # The flag by which a failed rank lets the others go would also make any check a right one.
    second = new_transport()
    with (
        pytest.warns(RuntimeWarning, match="does not hold what was written"),
        pytest.raises(DeviceMemoryUnavailable, match="does not hold what was written"),
    ):
        second.start([lambda: False])
    second.close()
    third = new_transport()
    third.start([lambda: True])
    third.close()

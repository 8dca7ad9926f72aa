"""The transport of a device, with memory that is not a GPU's: attempts that do not work."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import TypeAlias

import pytest
from fake_device_memory import FAKES

from gmijax.collectives.device_transport import DeviceTransport
from gmijax.collectives.host.shared_block import LANES, create_exchange
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.strategies import stages
from gmijax.errors import DeviceMemoryUnavailable
from gmijax.partition.layout import Layout

SIZE = 5

NewTransport: TypeAlias = Callable[[], DeviceTransport]


@pytest.fixture
def new_transport() -> Iterator[NewTransport]:
    """Makes the transport of the only rank, each time over the same shared block."""
    fd, layout = create_exchange(), Layout.even(1, 1)
    times = {"timeout_s": 20.0, "rendezvous_timeout_s": 20.0}
    lanes = [SharedMemoryGroup(fd, 0, 1, SIZE, lane=lane, **times) for lane in range(LANES)]
    os.close(fd)
    parts = stages("one_shot", layout, "ipc")
    yield lambda: DeviceTransport(*lanes, layout, SIZE, parts, FAKES["fake"])
    for lane in lanes:
        lane.close()


def test_a_second_attempt_does_not_begin_with_the_flags_of_the_first(
    new_transport: NewTransport,
) -> None:
    def fails() -> bool:
        raise RuntimeError("CUDA_ERROR_INVALID_VALUE")

    first = new_transport()
    with pytest.raises(DeviceMemoryUnavailable, match="CUDA_ERROR_INVALID_VALUE"):
        first.start([fails])
    first.close()
    # The flag by which a failed rank lets the others go would also make any trial a right one.
    second = new_transport()
    with pytest.raises(DeviceMemoryUnavailable, match="does not hold what was written"):
        second.start([lambda: False])
    second.close()
    third = new_transport()
    third.start([lambda: True])
    third.close()

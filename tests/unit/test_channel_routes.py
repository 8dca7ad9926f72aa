"""Which trainer gets a transfer of the experience channels, and how large transfers become."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from gmijax.channels.compressor import START_BYTES, TransferSize
from gmijax.channels.migrator import Migrator
from gmijax.errors import GmijaxError, PeerLost, PipeClosed


class FakeWriter:
    """A way whose load the test sets."""

    def __init__(self, peer: int, load: int = 0, *, is_full: bool = False) -> None:
        self.peer, self.load, self.is_full = peer, load, is_full

    def try_reserve(self, sizes: Sequence[int]) -> list[Any] | None:
        return None if self.is_full else [np.zeros(size, np.uint8) for size in sizes]

    def load_bytes(self) -> int:
        return self.load


@pytest.mark.parametrize(
    ("loads", "full", "near", "chosen"),
    [
        ((500, 100, 300), None, (), [2, 2]),
        ((500, 100, 300), None, (1,), [1, 1]),
        ((0, 100, 300), 2, (2,), [None]),
        ((0, 100, 99), 1, (), [3]),
        ((0, 0, 0), None, (), [1, 2, 3, 1]),
    ],
)
def test_same_gpu_first_then_the_least_load_then_in_turn(
    loads: tuple[int, ...], full: int | None, near: tuple[int, ...], chosen: list[int | None]
) -> None:
    writers: list[Any] = [
        FakeWriter(peer, load, is_full=peer == full) for peer, load in enumerate(loads, start=1)
    ]
    migrator = Migrator(writers, near)
    opened = [migrator.try_open([10]) for _ in chosen]
    assert [None if found is None else found[0].peer for found in opened] == chosen


class LostWriter(FakeWriter):
    """A way to a trainer that closed, or whose process is gone."""

    def __init__(self, peer: int, error: GmijaxError) -> None:
        super().__init__(peer)
        self.error = error

    def try_reserve(self, sizes: Sequence[int]) -> list[Any] | None:
        if isinstance(self.error, PipeClosed):
            raise self.error
        return None

    def why_lost(self, operation: str, step: int) -> GmijaxError | None:
        return self.error


def test_a_dead_trainer_is_named_before_one_that_has_left_because_of_it() -> None:
    left: Any = LostWriter(1, PipeClosed(0, 1, "send"))
    dead: Any = LostWriter(2, PeerLost(0, 2, "send", 5))
    migrator = Migrator([left, dead], ())
    with pytest.raises(PeerLost, match="GMI 2 is gone"):
        migrator.try_open([10])
    assert migrator.why_lost() is dead.error
    with pytest.raises(PipeClosed):
        Migrator([left], ()).try_open([10])


def test_the_size_of_transfers_grows_while_a_byte_gets_cheaper() -> None:
    size = TransferSize(2**24)
    tried = set()
    while not size.is_tuned:
        tried.add(size.num_bytes)
        size.record(size.num_bytes, 20e-6 + size.num_bytes / 5e9)
    # 20 us are 5 % of the time of 2 MB at 5 GB/s, so that doubling gains less than that there.
    assert size.num_bytes == 2**20
    assert tried == {2**power for power in range(16, 22)}
    assert TransferSize(100).num_bytes == 100 < START_BYTES

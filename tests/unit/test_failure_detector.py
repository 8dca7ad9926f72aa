"""Who is named when a wait goes wrong: ranks as threads or as mere lines of the block."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from gmijax.collectives.host.barrier import Barrier
from gmijax.collectives.host.shared_block import LANES, SharedBlock, attach, create_exchange
from gmijax.errors import CollectiveTimeout, CudaError, PeerLost

NEVER = threading.Event()


@pytest.fixture
def blocks() -> list[SharedBlock]:
    """The first lane of a block, as each of three ranks sees it."""
    return lanes_of_three_ranks()[0]


def lanes_of_three_ranks() -> list[list[SharedBlock]]:
    """A block as each rank sees it, by lane."""
    fd = create_exchange()
    try:
        return [[attach(fd, rank, 3, 10, lane) for rank in range(3)] for lane in range(LANES)]
    finally:
        os.close(fd)


def barriers_of(blocks: list[SharedBlock], *timeouts_s: float) -> list[Barrier]:
    """All three ranks, attached."""
    return [Barrier(block, t, t) for block, t in zip(blocks, timeouts_s, strict=True)]


def end(blocks: list[SharedBlock], rank: int, suspect: int | None = None) -> None:
    """Makes `rank` look as if its process had ended, having given up for `suspect`."""
    blocks[rank].lines["pid"][rank] = 0
    blocks[rank].suspect[rank] = 0 if suspect is None else suspect + 1


def test_who_waits_too_is_not_named(blocks: list[SharedBlock]) -> None:
    first, second, _ = barriers_of(blocks, 1.2, 3.0, 3.0)
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second.watch, NEVER)
        with pytest.raises(CollectiveTimeout, match=r"waited 1\.2 s .* for GMIs \[2\]"):
            first.watch(NEVER)
        end(blocks, 0, suspect=2)
        with pytest.raises(CollectiveTimeout, match=r"GMI 1: .* for GMIs \[2\]"):
            other.result()


def test_a_call_that_only_this_rank_does_not_finish_times_out(blocks: list[SharedBlock]) -> None:
    first, *others = barriers_of(blocks, 0.3, 3.0, 3.0)
    for other in others:
        other.arrive()
    with pytest.raises(CollectiveTimeout, match=r"for GMIs \[1, 2\]"):
        first.watch(NEVER)


def test_the_dead_are_named_and_not_those_who_gave_up_for_them(
    blocks: list[SharedBlock],
) -> None:
    first = barriers_of(blocks, 3.0, 3.0, 3.0)[0]
    end(blocks, 1, suspect=2)
    end(blocks, 2)
    with pytest.raises(PeerLost) as lost:
        first.watch(NEVER)
    assert lost.value.peer == 2
    assert blocks[0].suspect[0] == 3


def test_who_gave_up_in_another_lane_is_not_named() -> None:
    outside, inside = lanes_of_three_ranks()
    first = barriers_of(outside, 3.0, 3.0, 3.0)[0]
    second = barriers_of(inside, 3.0, 3.0, 3.0)[1]
    for lane in (outside, inside):
        lane[2].lines["pid"][2] = 0
    with pytest.raises(PeerLost):
        second.watch(NEVER)
    outside[1].lines["pid"][1] = 0
    with pytest.raises(PeerLost) as lost:
        first.watch(NEVER)
    assert lost.value.peer == 2


def test_one_that_gave_up_for_a_stuck_rank_points_at_it(blocks: list[SharedBlock]) -> None:
    first = barriers_of(blocks, 3.0, 3.0, 3.0)[0]
    end(blocks, 1, suspect=2)
    with pytest.raises(CollectiveTimeout, match=r"for GMIs \[2\]"):
        first.watch(NEVER)


def test_one_that_gave_up_and_still_runs_is_not_named(blocks: list[SharedBlock]) -> None:
    first = barriers_of(blocks, 0.9, 3.0, 3.0)[0]
    blocks[1].suspect[1] = 3
    with pytest.raises(CollectiveTimeout, match=r"for GMIs \[2\]"):
        first.watch(NEVER)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("connection reset"),
        CudaError("cannot copy into shared GPU memory: cudaErrorMpsClientTerminated"),
    ],
)
def test_a_failed_transfer_is_blamed_on_the_dead(
    blocks: list[SharedBlock], error: Exception
) -> None:
    first, second, _ = barriers_of(blocks, 30, 30, 30)
    threading.Timer(0.4, end, (blocks, 2)).start()  # The error comes before the death.
    with pytest.raises(PeerLost) as lost, first.raise_peer_failure():
        raise error
    assert lost.value.peer == 2
    end(blocks, 0, suspect=blocks[0].suspect[0] - 1)  # It ends for that reason.
    with pytest.raises(PeerLost) as lost:
        second.watch(NEVER)
    assert lost.value.peer == 2


def test_the_watch_of_a_step_has_no_end_while_all_are_at_it(blocks: list[SharedBlock]) -> None:
    everyone = barriers_of(blocks, 0.3, 0.3, 0.3)
    done = threading.Event()
    threading.Timer(1.5, done.set).start()
    with ThreadPoolExecutor(3) as pool:
        for waiting in [pool.submit(one.watch, done) for one in everyone]:
            waiting.result()


def test_the_watch_of_a_step_names_the_silent(blocks: list[SharedBlock]) -> None:
    first, second, _ = barriers_of(blocks, 0.5, 30.0, 30.0)
    done = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second.watch, done)
        with pytest.raises(CollectiveTimeout, match=r"for GMIs \[2\]"):
            first.watch(NEVER)
        done.set()
        other.result()


def test_the_watch_of_a_step_looks_at_those_who_have_arrived_after_it(
    blocks: list[SharedBlock],
) -> None:
    first, *others = barriers_of(blocks, 0.3, 30.0, 30.0)
    done = threading.Event()
    with ThreadPoolExecutor(3) as pool:
        meeting = [pool.submit(other.wait, while_unresponsive=True) for other in others]
        threading.Timer(1.5, done.set).start()
        first.watch(done)  # They wait for this one, and are not late.
        first.wait()
        for other in meeting:
            other.result()
    others[0].arrive()
    end(blocks, 1)
    with pytest.raises(PeerLost, match="GMI 1 is gone"):
        first.watch(NEVER)


def test_an_error_of_ones_own_stays_what_it_is(
    blocks: list[SharedBlock], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.host.barrier.SETTLE_S", 0.1)
    first, *_ = barriers_of(blocks, 5.0, 5.0, 5.0)
    with pytest.raises(RuntimeError, match="out of memory"), first.raise_peer_failure():
        raise RuntimeError("out of memory")
    with pytest.raises(CudaError, match="cannot copy"), first.raise_peer_failure():
        raise CudaError("cannot copy")

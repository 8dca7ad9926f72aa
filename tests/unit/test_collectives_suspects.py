"""Who is named when a wait goes wrong: ranks as threads or as mere lines of the block."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from gmijax.collectives.memory import ExchangeBlock, attach, create_exchange
from gmijax.collectives.suspects import Suspects
from gmijax.collectives.turns import Turns
from gmijax.errors import CollectiveError, CollectiveTimeout, CudaError, PeerLost

NEVER = threading.Event()


@pytest.fixture
def blocks() -> Iterator[list[ExchangeBlock]]:
    """The block as three ranks see it."""
    fd = create_exchange()
    yield [attach(fd, rank, 3, 10) for rank in range(3)]
    os.close(fd)


def turns_of(blocks: list[ExchangeBlock], *timeouts_s: float) -> list[Turns]:
    """All three ranks, attached."""
    return [Turns(block, t, t) for block, t in zip(blocks, timeouts_s, strict=True)]


def end(blocks: list[ExchangeBlock], rank: int, blamed: int | None = None) -> None:
    """Makes `rank` look as if its process had ended, having given up for `blamed`."""
    line = blocks[rank].lines[rank]
    line["pid"], line["blamed"] = 0, 0 if blamed is None else blamed + 1


def test_a_watch_ends_with_the_call(blocks: list[ExchangeBlock]) -> None:
    turns = turns_of(blocks, 5, 5, 5)[0]
    done = threading.Event()
    threading.Timer(0.3, done.set).start()
    started = time.monotonic()
    turns.watch(done)
    assert 0.2 < time.monotonic() - started < 2.0


def test_who_waits_too_is_not_named(blocks: list[ExchangeBlock]) -> None:
    first, second, _ = turns_of(blocks, 1.2, 3.0, 3.0)
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second.watch, NEVER)
        with pytest.raises(CollectiveTimeout, match=r"waited 1\.2 s .* for ranks \[2\]"):
            first.watch(NEVER)
        end(blocks, 0, blamed=2)
        with pytest.raises(CollectiveTimeout, match=r"rank 1: .* for ranks \[2\]"):
            other.result()


def test_a_call_that_only_this_rank_does_not_finish_times_out(blocks: list[ExchangeBlock]) -> None:
    first, *others = turns_of(blocks, 0.3, 3.0, 3.0)
    for other in others:
        other.arrive()
    with pytest.raises(CollectiveTimeout, match=r"for ranks \[1, 2\]"):
        first.watch(NEVER)


def test_the_dead_are_named_and_not_those_who_gave_up_for_them(
    blocks: list[ExchangeBlock],
) -> None:
    first = turns_of(blocks, 3.0, 3.0, 3.0)[0]
    end(blocks, 1, blamed=2)
    end(blocks, 2)
    with pytest.raises(PeerLost) as lost:
        first.watch(NEVER)
    assert lost.value.peer == 2
    assert blocks[0].lines["blamed"][0] == 3


def test_one_that_gave_up_for_a_stuck_rank_points_at_it(blocks: list[ExchangeBlock]) -> None:
    first = turns_of(blocks, 3.0, 3.0, 3.0)[0]
    end(blocks, 1, blamed=2)
    with pytest.raises(CollectiveTimeout, match=r"for ranks \[2\]"):
        first.watch(NEVER)


def test_a_failed_transfer_is_blamed_on_the_dead(blocks: list[ExchangeBlock]) -> None:
    first = turns_of(blocks, 30, 30, 30)[0]
    threading.Timer(0.4, end, (blocks, 1)).start()
    with pytest.raises(PeerLost) as lost:
        first.explain_failure()
    assert lost.value.peer == 1


def test_the_watch_of_a_step_has_no_end_while_all_are_at_it(blocks: list[ExchangeBlock]) -> None:
    everyone = turns_of(blocks, 0.3, 0.3, 0.3)
    done = threading.Event()
    threading.Timer(1.5, done.set).start()
    with ThreadPoolExecutor(3) as pool:
        for waiting in [pool.submit(one.watch, done, is_step=True) for one in everyone]:
            waiting.result()


def test_the_watch_of_a_step_names_the_silent(blocks: list[ExchangeBlock]) -> None:
    first, second, _ = turns_of(blocks, 0.5, 30.0, 30.0)
    done = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second.watch, done, is_step=True)
        with pytest.raises(CollectiveTimeout, match=r"for ranks \[2\]"):
            first.watch(NEVER, is_step=True)
        done.set()
        other.result()


def test_the_watch_of_a_step_looks_at_those_who_have_arrived_after_it(
    blocks: list[ExchangeBlock],
) -> None:
    first, *others = turns_of(blocks, 0.3, 30.0, 30.0)
    done = threading.Event()
    with ThreadPoolExecutor(3) as pool:
        meeting = [pool.submit(other.meet, is_patient=True) for other in others]
        threading.Timer(1.5, done.set).start()
        first.watch(done, is_step=True)  # They wait for this one, and are not late.
        first.meet()
        for other in meeting:
            other.result()
    others[0].arrive()
    end(blocks, 1)
    with pytest.raises(PeerLost, match="peer 1 is gone"):
        first.watch(NEVER, is_step=True)


def test_the_watch_of_a_step_notices_the_dead(blocks: list[ExchangeBlock]) -> None:
    first, *_ = turns_of(blocks, 5.0, 5.0, 5.0)
    end(blocks, 1)
    with pytest.raises(PeerLost, match="peer 1 is gone"):
        first.watch(NEVER, is_step=True)


def test_an_error_of_ones_own_can_stay_what_it_is(
    blocks: list[ExchangeBlock], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.turns.SETTLE_S", 0.1)
    first, *_ = turns_of(blocks, 5.0, 5.0, 5.0)
    with pytest.raises(RuntimeError, match="out of memory"), first.explained(is_step=True):
        raise RuntimeError("out of memory")
    with pytest.raises(CollectiveError, match="out of memory"), first.explained():
        raise RuntimeError("out of memory")
    end(blocks, 1)
    with pytest.raises(PeerLost, match="peer 1 is gone"), first.explained(is_step=True):
        raise RuntimeError("connection reset")


@pytest.mark.parametrize("is_step", [False, True])
def test_a_copy_that_cuda_refuses_is_blamed_on_the_dead(
    blocks: list[ExchangeBlock], is_step: bool
) -> None:
    first, second, _ = turns_of(blocks, 5.0, 5.0, 5.0)
    end(blocks, 2)
    with pytest.raises(PeerLost) as lost, first.explained(is_step=is_step):
        raise CudaError("cannot copy into shared GPU memory: cudaErrorMpsClientTerminated")
    assert lost.value.peer == 2
    end(blocks, 0, blamed=blocks[0].lines["blamed"][0] - 1)  # It ends for that reason.
    with pytest.raises(PeerLost) as lost:
        second.watch(NEVER)
    assert lost.value.peer == 2


def test_a_copy_that_cuda_refuses_keeps_its_words(
    blocks: list[ExchangeBlock], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gmijax.collectives.turns.SETTLE_S", 0.1)
    first, *_ = turns_of(blocks, 5.0, 5.0, 5.0)
    with pytest.raises(CollectiveError, match="rank 0: , step 0: cannot copy"), first.explained():
        raise CudaError("cannot copy")


def test_a_process_is_looked_at_after_its_counter(
    blocks: list[ExchangeBlock], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That there is a fence: what it does cannot be seen on x86, which keeps the order anyway."""
    Turns(blocks[1], 1.0, 1.0)
    pid = int(blocks[1].lines["pid"][1])
    blocks[1].lines["pid"][1] = 0  # As seen before the counter, by an early read.

    def all_before_is_seen() -> None:
        blocks[1].lines["pid"][1] = pid

    monkeypatch.setattr("gmijax.collectives.suspects.fence", all_before_is_seen)
    Suspects(blocks[0], "mean", 1, 1.0).look(lambda: [1], now=True)  # Nobody is gone.

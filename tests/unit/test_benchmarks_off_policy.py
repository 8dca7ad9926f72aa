"""The measurement of a learner beside its agents: who waits for whom, and what is said of it."""

from __future__ import annotations

import queue
import threading
from typing import Any

import pytest

from benchmarks.evaluation.async_tables import over_the_same_ratio
from benchmarks.off_policy import LEAD, held_rate, summary


class Two:
    """Two roles in threads, and how many iterations each has made."""

    def __init__(self) -> None:
        self.messages = [queue.Queue[int](), queue.Queue[int]()]
        self.barrier = threading.Barrier(2, timeout=30)
        self.done = [0, 0]
        self.furthest = 0


class Half:
    """What `held_rate` needs of a role."""

    def __init__(self, both: Two, rank: int) -> None:
        self.both, self.rank = both, rank

    def collective(self, data: float) -> float:
        self.both.barrier.wait()
        return data

    def send(self, data: int, dst: int) -> None:
        self.both.messages[dst].put(data)

    def recv(self, src: int) -> int:
        del src
        return self.both.messages[self.rank].get(timeout=30)

    def step(self) -> None:
        done = self.both.done
        done[self.rank] += 1
        self.both.furthest = max(self.both.furthest, done[self.rank] - done[1 - self.rank])


def test_neither_gmi_gets_far_ahead_where_the_ratio_is_held():
    both = Two()
    halves: list[Any] = [Half(both, rank) for rank in range(2)]
    threads = [
        threading.Thread(target=held_rate, args=(half, half.step, 200), daemon=True)
        for half in halves
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert both.done == [200, 200]
    assert both.furthest <= LEAD


def test_gains_are_medians_by_backend():
    repeats = [
        {"backend": backend, "gain": {"held": held, "rounds_free": 1.0, "updates_free": 1.0}}
        for backend, held in (("mps", 1.0), ("mps", 3.0), ("share", 0.5), ("mps", 1.2))
    ]
    found = {backend: gain["held"] for backend, gain in summary(repeats).items()}
    assert found == pytest.approx({"mps": 1.2, "share": 0.5})


def test_free_gmis_are_compared_with_one_program_of_their_ratio() -> None:
    # A round takes one program 10 ms and its two updates 20 ms; the two GMIs make 50 rounds/s.
    repeat = {
        "in_turn": {"acting_alone_rounds_per_s": 100.0, "learning_alone_updates_per_s": 100.0},
        "two_gmis": {"free_rounds_per_s": 50.0, "free_updates_per_s": 100.0},
    }
    assert over_the_same_ratio(repeat) == pytest.approx(1.5)

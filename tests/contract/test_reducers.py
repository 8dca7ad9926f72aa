"""What every reduction strategy promises, checked with real processes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from gmijax.collectives.build import STRATEGIES
from gmijax.partition.layout import Layout
from tests.rank_processes import Ranks

ENTRIES = [
    pytest.param(strategy, ranks, id=f"{strategy}-{ranks}")
    for strategy, entry in STRATEGIES.items()
    for ranks in (1, 2, 4)
    if entry.why_not(Layout.even(1, ranks)) is None
]
SEVERAL = [entry for entry in ENTRIES if entry.values[1] == 4]


@pytest.mark.parametrize("num_floats", [1, 17, 100_003])
@pytest.mark.parametrize(("strategy", "ranks"), ENTRIES)
def test_mean_equals_numpys_and_is_bit_identical_on_all_ranks(
    strategy: str, ranks: int, num_floats: int, tmp_path: Path
) -> None:
    options = {"strategy": strategy, "num_floats": num_floats, "num_calls": 6}
    with Ranks(tmp_path, ranks, "check_means", **options).start() as job:
        results = job.results()
    assert [result["error"] for result in results] == [None] * ranks, results
    assert len({result["digest"] for result in results}) == 1


@pytest.mark.parametrize(("strategy", "ranks"), ENTRIES)
def test_calls_do_not_mix_steps(strategy: str, ranks: int, tmp_path: Path) -> None:
    options = {"strategy": strategy, "num_floats": 1000, "num_calls": 1000}
    with Ranks(tmp_path, ranks, "check_order", **options).start() as job:
        assert [result["error"] for result in job.results()] == [None] * ranks


@pytest.mark.parametrize("victim", [0, 2])
@pytest.mark.parametrize(("strategy", "ranks"), SEVERAL)
def test_a_killed_peer_is_named_by_all_others_within_two_seconds(
    strategy: str, ranks: int, victim: int, tmp_path: Path
) -> None:
    with Ranks(tmp_path, ranks, "call_forever", strategy=strategy).start() as job:
        job.wait_for("running")
        named_memory = job.named_memory()
        killed_at_s = job.signal(victim, signal.SIGKILL)
        results = job.results(*(rank for rank in range(ranks) if rank != victim))
    assert [(r["error"], r.get("peer")) for r in results] == [("PeerLost", victim)] * (ranks - 1)
    assert max(result["failed_at_s"] for result in results) - killed_at_s < 2.0
    assert not [path for path in named_memory if path.exists()]


@pytest.mark.parametrize(("strategy", "ranks"), SEVERAL)
def test_a_stuck_peer_is_named_by_all_others_at_the_timeout(
    strategy: str, ranks: int, tmp_path: Path
) -> None:
    victim, timeout_s = 1, 1.0
    options = {"strategy": strategy, "timeout_s": timeout_s}
    with Ranks(tmp_path, ranks, "call_forever", **options).start() as job:
        job.wait_for("running")
        stopped_at_s = job.signal(victim, signal.SIGSTOP)
        results = job.results(*(rank for rank in range(ranks) if rank != victim))
    for result in results:
        assert (result["error"], result["missing"]) == ("CollectiveTimeout", [victim])
        # A rank that met the victim a moment before may count from there.
        assert timeout_s - 0.2 < result["failed_at_s"] - stopped_at_s < timeout_s + 1.0

"""What every reduction strategy promises, checked with real processes."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import NamedTuple

import pytest

from gmijax.collectives.build import STRATEGIES
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy
from tests.rank_processes import Ranks

pytestmark = pytest.mark.timeout(200)


class Case(NamedTuple):
    """A layout, the length of its buffers, and how its ranks end."""

    layout: Layout
    num_floats: int
    signal: signal.Signals | None
    victim: int


CASES = [
    Case(Layout(((0,),)), 1000, None, 0),
    Case(Layout(((0, 1),)), 17, signal.SIGSTOP, 1),
    Case(Layout(((0,), (1,))), 100_003, signal.SIGKILL, 0),
    Case(Layout(((0, 1), (2, 3))), 4099, signal.SIGSTOP, 0),
    Case(Layout(((0, 1, 2), (3, 4, 5))), 100_003, signal.SIGKILL, 4),
    Case(Layout(((0, 1), (2,))), 1, signal.SIGKILL, 2),
]
PAIRS = [
    (strategy, case)
    for strategy in STRATEGIES
    for case in CASES
    if why_not_strategy(strategy, case.layout) is None
]
TIMEOUT_S = 3.0


def test_every_strategy_has_a_case_with_several_gmis() -> None:
    several = {strategy for strategy, case in PAIRS if case.layout.num_gmis > 1}
    assert several == STRATEGIES.keys() - {"none"}


@pytest.mark.parametrize(
    ("strategy", "case"), PAIRS, ids=[f"{name}-{case.layout}" for name, case in PAIRS]
)
def test_the_contract(strategy: str, case: Case, tmp_path: Path) -> None:
    """The mean is numpy's, the same on all ranks; calls do not mix; the end of a rank is named.

    One test and not several: starting the processes is most of what it costs.
    """
    ranks = case.layout.num_gmis
    options = {
        "strategy": strategy,
        "layout": case.layout.gmis_of_gpu,
        "num_floats": case.num_floats,
        "num_calls": 6,
        "num_ordered_calls": 200,
        "timeout_s": TIMEOUT_S,
        "goes_on": case.signal is not None,
    }
    with Ranks(tmp_path, ranks, "check_all", **options).start() as job:
        if case.signal is None:
            checked = results = job.results()
        else:
            job.wait_for("running")
            checked = [
                json.loads((tmp_path / f"checked_{rank}").read_text()) for rank in range(ranks)
            ]
            named_memory = job.named_memory()
            sent_s = job.signal(case.victim, case.signal)
            results = job.results(*(rank for rank in range(ranks) if rank != case.victim))
            assert not [path for path in named_memory if path.exists()]
    assert len({result["digest"] for result in checked}) == 1
    for result in results:
        if case.signal is None:
            assert result["error"] is None, result
            continue
        after_s = result["failed_at_s"] - sent_s
        if case.signal == signal.SIGKILL:
            assert (result["error"], result.get("peer")) == ("PeerLost", case.victim), result
            assert after_s < 2.0
        else:
            assert result["error"] == "CollectiveTimeout", result
            assert result["missing"] == [case.victim]
            # A rank that met the victim a moment before may count from there.
            assert TIMEOUT_S - 0.2 < after_s < TIMEOUT_S + 1.5
        assert "mean, step" in result["message"]


@pytest.mark.parametrize("num_floats", [1, 17, 100_003])
@pytest.mark.parametrize("ranks", [1, 2, 4])
def test_the_mean_of_mpr_for_many_sizes(ranks: int, num_floats: int, tmp_path: Path) -> None:
    options = {"num_floats": num_floats, "num_calls": 6}
    with Ranks(tmp_path, ranks, "check_means", **options).start() as job:
        results = job.results()
    assert [result["error"] for result in results] == [None] * ranks, results
    assert len({result["digest"] for result in results}) == 1


@pytest.mark.parametrize("victim", [0, 2])
def test_a_killed_peer_is_named_by_all_others_within_two_seconds(
    victim: int, tmp_path: Path
) -> None:
    with Ranks(tmp_path, 4, "call_forever").start() as job:
        job.wait_for("running")
        killed_at_s = job.signal(victim, signal.SIGKILL)
        results = job.results(*(rank for rank in range(4) if rank != victim))
    assert [(r["error"], r.get("peer")) for r in results] == [("PeerLost", victim)] * 3
    assert max(result["failed_at_s"] for result in results) - killed_at_s < 2.0

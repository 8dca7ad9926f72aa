"""What every reduction strategy promises, checked with real processes."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from gmijax.collectives.build import STRATEGIES
from tests.rank_processes import Ranks
from tests.reducer_contract import PAIRS, Case, check_contract

pytestmark = pytest.mark.timeout(200)


def test_every_strategy_has_a_case_with_several_gmis() -> None:
    several = {strategy for strategy, _, case in PAIRS if case.layout.num_gmis > 1}
    assert several == STRATEGIES.keys() - {"none"}


@pytest.mark.parametrize(
    ("strategy", "intra", "case"),
    PAIRS,
    ids=[f"{name}-{intra}-{case.layout}" for name, intra, case in PAIRS],
)
def test_the_contract(strategy: str, intra: str, case: Case, tmp_path: Path) -> None:
    # Here `ipc` has the real exchange, and a file without a name as memory of the device.
    check_contract(strategy, intra, case, tmp_path)


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


@pytest.mark.parametrize("host_if_unavailable", [True, False])
@pytest.mark.parametrize(
    ("strategy", "layout", "wish", "instead"),
    [
        ("har", [[0, 1]], "reduce.intra=ipc", "through host memory"),
        ("one_shot", [[0], [1]], "reduce.strategy=one_shot", "reduce.strategy=mpr"),
    ],
)
def test_device_memory_that_does_not_work_is_found_by_all(
    strategy: str,
    layout: list[list[int]],
    wish: str,
    instead: str,
    host_if_unavailable: bool,
    tmp_path: Path,
) -> None:
    options = {
        "strategy": strategy,
        "intra": "ipc",
        "layout": layout,
        "num_calls": 2,
        "special_rank": 1,
        "special": "BrokenDeviceMemory",
        "host_if_unavailable": host_if_unavailable,
    }
    with Ranks(tmp_path, 2, "check_means", **options).start() as job:
        results = job.results()
    said = f"{wish}: rank 0: shared GPU memory does not hold what was written into it"
    for rank, result in enumerate(results):
        if host_if_unavailable:
            assert result["error"] is None
            assert f"{said}; so {instead}" in (tmp_path / f"stderr_{rank}").read_text()
        else:
            assert (result["error"], result["message"]) == ("DeviceMemoryUnavailable", said)


def test_exchanges_in_a_program_that_fail_on_one_rank_are_left_to_the_host(tmp_path: Path) -> None:
    special = {"special_rank": 1, "special": "WithFailingQueue"}
    options = {"strategy": "one_shot", "intra": "ipc", "num_calls": 2, "goes_on": False, **special}
    layout = [[0, 1], [2]]
    with Ranks(
        tmp_path, 3, "check_all", layout=layout, num_ordered_calls=50, **options
    ).start() as job:
        results = job.results()
    for rank, result in enumerate(results):
        # Means from outside a program are right before and after it was tried.
        assert (result["error"], result["steps_digest"]) == (None, None), result
        said = (tmp_path / f"stderr_{rank}").read_text()
        assert "rank 1: INTERNAL: gmijax_exchange_0: CUDA_ERROR_INVALID_VALUE; so the host" in said


def test_exchanges_in_different_orders_fail_and_do_not_mix(tmp_path: Path) -> None:
    options = {"strategy": "one_shot", "intra": "ipc", "num_floats": 64, "timeout_s": 5.0}
    with Ranks(tmp_path, 2, "step_in_different_orders", **options).start() as job:
        results = job.results()
    assert {result["error"] for result in results} <= {"CollectiveError", "PeerLost"}
    said = [result["message"] for result in results if result["error"] == "CollectiveError"]
    assert said
    for message in said:
        assert "have come to their exchanges in different orders; here it is number" in message

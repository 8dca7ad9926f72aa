"""What every reduction strategy promises, checked with real processes."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from training_jobs import wait_until

from gmijax.collectives.strategies import COSTS
from tests.communicator_contract import (
    PAIRS,
    RINGS_OVER_NODES,
    Case,
    RingsOverNodes,
    check_contract,
    check_rings_over_nodes,
)
from tests.rank_processes import Ranks

pytestmark = pytest.mark.timeout(200)


def test_every_strategy_has_a_case_with_several_gmis() -> None:
    several = {strategy for strategy, _, case in PAIRS if case.layout.num_gmis > 1}
    assert several == COSTS.keys()


@pytest.mark.parametrize(
    ("strategy", "intra", "case"),
    PAIRS,
    ids=[f"{name}-{intra}-{case.layout}" for name, intra, case in PAIRS],
)
def test_the_contract(strategy: str, intra: str, case: Case, tmp_path: Path) -> None:
    # Here `ipc` has the real exchange, and a file without a name as memory of the device.
    check_contract(strategy, intra, case, tmp_path)


@pytest.mark.parametrize("victim", [0, 2])
def test_a_killed_peer_is_named_by_all_others_before_their_time_limit(
    victim: int, tmp_path: Path
) -> None:
    with Ranks(tmp_path, 4, "call_forever", timeout_s=80.0).start() as job:
        job.wait_for("running")
        job.signal(victim, signal.SIGKILL)
        results = job.results(*(rank for rank in range(4) if rank != victim))
    assert [(r["error"], r.get("peer")) for r in results] == [("PeerLost", victim)] * 3


def test_a_rank_killed_before_its_first_call_is_lost(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once").start(1, pause_s=20.0) as job:
        job.wait_for("attached")
        job.signal(1, signal.SIGKILL)
        job.start(0)
        (result,) = job.results(0)
    assert (result["error"], result["peer"]) == ("PeerLost", 1)


@pytest.mark.parametrize(
    ("strategy", "layout", "instead"),
    [
        ("har", [[0, 1]], "reduce.strategy=har through host memory"),
        ("one_shot", [[0], [1]], "reduce.strategy=mpr through host memory"),
        ("one_shot", [[0], [1]], None),
    ],
)
def test_device_memory_that_does_not_work_is_found_by_all(
    strategy: str, layout: list[list[int]], instead: str | None, tmp_path: Path
) -> None:
    options = {
        "strategy": strategy,
        "intra": "ipc",
        "layout": layout,
        "num_calls": 2,
        "special_rank": 1,
        "special": "forgetful",
        "host_if_unavailable": instead is not None,
    }
    with Ranks(tmp_path, 2, "check_means", **options).start() as job:
        results = job.results()
    message = "shared GPU memory does not hold what was written into it"
    for rank, result in enumerate(results):
        if instead is not None:
            assert result["error"] is None
            assert f"{message}; so {instead}" in (tmp_path / f"stderr_{rank}").read_text()
        else:
            assert result["error"] == "DeviceMemoryUnavailable"
            assert result["message"].endswith(message)


def test_device_memory_that_one_node_lacks_is_used_by_none(tmp_path: Path) -> None:
    options = {"strategy": "one_shot", "intra": "ipc", "num_calls": 2, "layout": [[0, 1], [2, 3]]}
    special = {"special_rank": 3, "special": "forgetful", "host_if_unavailable": True}
    with Ranks(tmp_path, 4, "check_means", num_nodes=2, **options, **special).start() as job:
        results = job.results()
    assert len({result["digest"] for result in results}) == 1
    for rank, result in enumerate(results):
        assert result["error"] is None, result
        message = "what was written into it; so reduce.strategy=mpr through host memory"
        assert message in (tmp_path / f"stderr_{rank}").read_text()


@pytest.mark.parametrize("case", RINGS_OVER_NODES, ids=str)
def test_nodes_exchange_in_rings_and_see_the_end_of_another(
    case: RingsOverNodes, tmp_path: Path
) -> None:
    """NCCL has a stand-in here; like it, that one waits for ever for who is gone."""
    check_rings_over_nodes(case, tmp_path)


@pytest.mark.parametrize(
    ("special", "special_ranks", "ways"),
    [
        # The first of a ring, who makes its id, has all that it needs.
        (
            "without_nccl4py",
            [2],
            ["import of nccl.bindings.nccl", "tried again by TCP between nodes instead of NCCL"],
        ),
        # All members of a ring fail alike.
        (
            "without_network",
            [0, 2],
            ["ncclSystemError; tried again by TCP between nodes instead of NCCL"],
        ),
        (
            "broken_network",
            [0, 2],
            ["ncclRemoteError; tried again by TCP between nodes instead of NCCL"],
        ),
        (
            *("forgetful", [3]),
            [
                "tried again by TCP between nodes instead of NCCL",
                "so reduce.strategy=mpr through host memory",
            ],
        ),
    ],
)
def test_what_some_ranks_lack_for_rings_over_nodes_is_used_by_none(
    special: str, special_ranks: list[int], ways: list[str], tmp_path: Path
) -> None:
    options = {"strategy": "one_shot", "intra": "ipc", "num_calls": 2, "layout": [[0, 1], [2, 3]]}
    options |= {"inter": "nccl", "special": special, "host_if_unavailable": True}
    with Ranks(tmp_path, 4, "check_means", num_nodes=2, **options) as job:
        for rank in range(4):
            job.start(rank, special_rank=rank if rank in special_ranks else None)
        results = job.results()
    assert len({result["digest"] for result in results}) == 1
    for rank, result in enumerate(results):
        assert result["error"] is None, result
        stderr = (tmp_path / f"stderr_{rank}").read_text()
        assert all(way in stderr for way in ways), stderr


@pytest.mark.parametrize(
    ("special", "message"),
    [
        ("without_network", "rings between GPUs: ncclSystemError"),
        ("broken_network", "exchange on the device's stream: .*ncclRemoteError"),
    ],
)
def test_what_one_member_of_a_ring_lacks_is_reported_while_the_others_wait_for_it(
    special: str, message: str, tmp_path: Path
) -> None:
    options = {"inter": "nccl", "layout": [[0], [1]], "num_nodes": 2, "num_calls": 2}
    options |= {"special_rank": 1, "special": special}
    with Ranks(tmp_path, 2, "check_means", strategy="flat", **options).start() as job:
        log = tmp_path / "stderr_1"
        wait_until(lambda: re.search(message, log.read_text()), 60, "it says why it does not work")
        assert not job.processes[0].ends_within(0.0)
        assert log.read_text().count(": RuntimeWarning: ") == 1


def test_a_device_that_takes_no_copies_leaves_exchanges_to_the_host(tmp_path: Path) -> None:
    options = {"strategy": "one_shot", "intra": "ipc", "num_calls": 2, "goes_on": False}
    special = {"special_rank": 1, "special": "failing_queue", "host_if_unavailable": True}
    with Ranks(
        tmp_path, 3, "check_all", layout=[[0, 1], [2]], num_ordered_calls=50, **options, **special
    ).start() as job:
        results = job.results()
    for rank, result in enumerate(results):
        assert result["error"] is None, result
        stderr = (tmp_path / f"stderr_{rank}").read_text()
        assert "GMI 1: INTERNAL: gmijax_exchange_0: CUDA_ERROR_INVALID_VALUE; so" in stderr


def test_exchanges_in_different_orders_fail_and_do_not_mix(tmp_path: Path) -> None:
    options = {"strategy": "one_shot", "intra": "ipc", "num_floats": 64, "timeout_s": 5.0}
    with Ranks(tmp_path, 2, "step_in_different_orders", **options).start() as job:
        results = job.results()
    # Who comes second sees it, and is gone when the other one looks.
    errors = {result["error"] for result in results}
    assert errors <= {"CollectiveError", "CollectiveTimeout", "PeerLost"}
    assert any("in different orders" in result["message"] for result in results)


def test_ranks_that_come_to_different_exchanges_in_the_host_name_both(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "step_in_different_orders", num_floats=64).start() as job:
        messages = [result["message"] for result in job.results()]
    mean, gather = "sum of 64 floats", "sum of 128 floats"
    assert messages[0].startswith(f"step 1: GMI 0 calls {mean}")
    assert f"GMI 1 calls {gather}" in messages[0]
    assert messages[1].startswith(f"step 1: GMI 1 calls {gather}")
    assert f"GMI 0 calls {mean}" in messages[1]

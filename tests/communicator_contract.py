"""What every reduction strategy promises, checked with real processes, on CPUs and on GPUs."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gmijax.collectives.strategies import COSTS
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import why_not_strategy
from tests.rank_processes import Ranks


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
    Case(Layout(((0, 1), (2, 3))), 4099, signal.SIGKILL, 0),
    Case(Layout(((0, 1, 2), (3, 4, 5))), 100_003, signal.SIGKILL, 4),
    Case(Layout(((0, 1), (2,))), 1, signal.SIGKILL, 2),
    Case(Layout(((0, 1), (2, 3)), 2), 4099, None, 0),
]
WAYS = {"har": ("host", "ipc"), "one_shot": ("ipc",)}
"""How the GMIs of a GPU exchange, where that is not host memory alone."""

PAIRS = [
    (strategy, intra, case)
    for strategy in ("none", *COSTS)
    for intra in WAYS.get(strategy, ("host",))
    for case in CASES
    if why_not_strategy(strategy, case.layout) is None
    # Between nodes all are alike; what is on a device in each of them is the most.
    and (case.layout.num_nodes == 1 or strategy == "one_shot")
]
STOP_NOTICED_S = 4.0
"""Time limit where a rank is stopped; where one is killed the limit is no part of the answer."""


def check_contract(
    strategy: str, intra: str, case: Case, folder: Path, gpus: Sequence[int] = ()
) -> None:
    """The mean is numpy's, the same on all ranks; calls do not mix; the end of a rank is named.

    All in one job: starting the processes is most of what it costs.

    Args:
      strategy: a reduction strategy.
      intra: exchange inside a GPU.
      case: layout, sizes, and how it ends.
      folder: for the files of the ranks.
      gpus: devices by position of a GPU in the layout; none: the CPU.
    """
    ranks = case.layout.num_gmis
    options = {
        "strategy": strategy,
        "intra": intra,
        "gpus": list(gpus),
        "layout": case.layout.gmis_of_gpu,
        "num_nodes": case.layout.num_nodes,
        "num_floats": case.num_floats,
        "num_calls": 6,
        "num_ordered_calls": 200,
        "timeout_s": STOP_NOTICED_S if case.signal == signal.SIGSTOP else 60.0,
        "goes_on": case.signal is not None,
    }
    with Ranks(folder, ranks, "check_all", **options).start() as job:
        if case.signal is None:
            checked = results = job.results()
        else:
            job.wait_for("running")
            checked = [
                json.loads((folder / f"checked_{rank}").read_text()) for rank in range(ranks)
            ]
            named_memory = job.named_memory()
            job.signal(case.victim, case.signal)
            results = job.results(*(rank for rank in range(ranks) if rank != case.victim))
            assert not [path for path in named_memory if path.exists()]
    assert len({result["digest"] for result in checked}) == 1
    assert len({result.get("steps_digest") for result in checked}) == 1
    for result in results:
        if case.signal is None:
            assert result["error"] is None, result
            continue
        if case.signal == signal.SIGKILL:
            assert (result["error"], result.get("peer")) == ("PeerLost", case.victim), result
        else:
            assert result["error"] == "CollectiveTimeout", result
            assert result["missing"] == [case.victim], result
        assert ", step" in result["message"]


class RingsOverNodes(NamedTuple):
    """Two nodes that exchange by NCCL, and how a rank of the second one ends."""

    strategy: str
    intra: str
    layout: tuple[tuple[int, ...], ...]
    victim: int
    signal: signal.Signals

    def __str__(self) -> str:
        return f"{self.strategy}-{Layout(self.layout)}-{self.victim}"


RINGS_OVER_NODES = [
    RingsOverNodes("flat", "host", ((0,), (1,)), 1, signal.SIGKILL),
    RingsOverNodes("one_shot", "ipc", ((0, 1), (2, 3)), 2, signal.SIGSTOP),
    RingsOverNodes("one_shot", "ipc", ((0, 1), (2, 3)), 3, signal.SIGKILL),
    RingsOverNodes("har", "ipc", ((0, 1), (2, 3)), 2, signal.SIGKILL),
]


def check_rings_over_nodes(case: RingsOverNodes, folder: Path, gpus: Sequence[int] = ()) -> None:
    """Means are right and the same on all; the end of a rank is seen on both nodes.

    Args:
      case: what is checked.
      folder: for the files of the ranks.
      gpus: devices by position of a GPU in the layout; none: the CPU, with stand-ins.
    """
    ranks, leader = Layout(case.layout).num_gmis, case.layout[1][0]
    is_kill = case.signal == signal.SIGKILL
    options = {
        "strategy": case.strategy,
        "intra": case.intra,
        "inter": "nccl",
        "gpus": list(gpus),
        "layout": case.layout,
        "num_nodes": 2,
        "num_floats": 4099,
        "num_calls": 4,
        "num_ordered_calls": 60,
        "timeout_s": 60.0 if is_kill else STOP_NOTICED_S,
        "goes_on": True,
    }
    with Ranks(folder, ranks, "check_all", **options).start() as job:
        job.wait_for("running")
        checked = [json.loads((folder / f"checked_{rank}").read_text()) for rank in range(ranks)]
        job.signal(case.victim, case.signal)
        left = [rank for rank in range(ranks) if rank != case.victim]
        results = dict(zip(left, job.results(*left), strict=True))
    for key in ("digest", "steps_digest"):
        assert len({result[key] for result in checked}) == 1
    # Nobody went another way.
    assert not any("TCP" in (folder / f"stderr_{rank}").read_text() for rank in left)
    # The leader of the first node watches that of the second, which is in one node with the rank.
    named = {0: leader} | {rank: case.victim for rank in case.layout[1] if rank in results}
    for rank, other in named.items():
        found = results[rank]
        assert found["error"] in ("PeerLost", "CollectiveTimeout"), found
        assert (found.get("peer") or found["missing"][0]) == other, found
    first = results[max(named)]
    assert first["error"] == ("PeerLost" if is_kill else "CollectiveTimeout"), first

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

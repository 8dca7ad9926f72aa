"""Steps in which GMIs wait for each other, and one of them ends or stops."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.rank_processes import Ranks


@pytest.mark.timeout(240)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize(
    ("strategy", "intra", "inter"),
    [("flat", "host", None), ("one_shot", "ipc", None), ("flat", "host", "nccl")],
)
def test_who_ends_while_all_run_a_step_is_named(
    strategy: str, intra: str, inter: str | None, number: signal.Signals, tmp_path: Path
) -> None:
    """And the others end, although their devices wait for the one that is gone or stopped."""
    # A kill is noticed at once, long before any time limit; a stop is not, but by one.
    limit_s, error = (60.0, "PeerLost") if number == signal.SIGKILL else (3.0, "CollectiveTimeout")
    way = {"strategy": strategy, "intra": intra, "layout": [[0], [1]], "timeout_s": limit_s}
    way |= {"inter": inter, "num_nodes": 2 if inter else 1}
    with ExitStack() as held:
        jobs = []
        for attempt in range(3):  # At another moment each; one is started while others wait.
            folder = tmp_path / str(attempt)
            folder.mkdir()
            job = held.enter_context(Ranks(folder, 2, "step_forever", **way))
            job.start().wait_for("running")
            time.sleep(attempt * 7e-3)
            job.signal(1, number)
            jobs.append(job)
        for job in jobs:
            (result,) = job.results(0)
            assert result["error"] == error, result
            assert result.get("peer", 1) == 1
            assert result.get("missing", [1]) == [1]

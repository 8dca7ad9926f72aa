"""GMIs that meet to form rings, and one of them fails on the way."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.rank_processes import Ranks


@pytest.mark.timeout(120)
@pytest.mark.parametrize("rank", [0, 1])
def test_one_that_fails_while_the_others_wait_ends_at_once(rank: int, tmp_path: Path) -> None:
    # Its library would wait five minutes for the others to say goodbye.
    layout = [[0], [1]]
    with Ranks(tmp_path, 2, "call_once", strategy="mrr", layout=layout) as job:
        started_s = time.monotonic()
        job.start(1 - rank)
        job.start(rank, num_floats=0)
        (result,) = job.results(rank)
        assert time.monotonic() - started_s < 60
    assert (result["error"], result["message"]) == (
        "ConfigError",
        "num_floats=0: must be at least 1",
    )


@pytest.mark.timeout(120)
def test_ranks_with_different_lengths_name_both(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once", strategy="mrr", layout=[[0], [1]]) as job:
        job.start(0, num_floats=100).start(1, num_floats=200)
        messages = [result["message"] for result in job.results()]
    assert all("do not fit together: num_floats is" in message for message in messages)


@pytest.mark.timeout(240)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize(("strategy", "intra"), [("flat", "host"), ("one_shot", "ipc")])
def test_who_ends_while_all_run_a_step_is_named(
    strategy: str, intra: str, number: signal.Signals, tmp_path: Path
) -> None:
    """And the others end, although their devices wait for the one that is gone or stopped."""
    for attempt in range(4):  # At another moment each.
        folder = tmp_path / str(attempt)
        folder.mkdir()
        way = {"strategy": strategy, "intra": intra, "layout": [[0], [1]]}
        with Ranks(folder, 2, "step_forever", **way, timeout_s=2.0) as job:
            job.start().wait_for("running")
            time.sleep(attempt * 7e-3)
            sent_s = job.signal(1, number)
            (result,) = job.results(0)
            if number == signal.SIGKILL:
                assert (result["error"], result.get("peer")) == ("PeerLost", 1), result
                assert result["failed_at_s"] - sent_s < 3.0  # Two of them if the library fails.
            else:
                assert (result["error"], result.get("missing")) == ("CollectiveTimeout", [1])
                assert 1.8 < result["failed_at_s"] - sent_s < 4.0


@pytest.mark.timeout(180)
@pytest.mark.parametrize("normalize_advantage", [True, False])
@pytest.mark.parametrize(("strategy", "layout"), [("har", [[0, 1]]), ("one_shot", [[0], [1, 2]])])
def test_exchanges_in_the_program_learn_what_the_host_does_between(
    strategy: str, layout: list[list[int]], normalize_advantage: bool, tmp_path: Path
) -> None:
    """PPO, with fake memory of a device; without it statistics and gradients are independent."""
    options = {
        "strategy": strategy,
        "intra": "ipc",
        "layout": layout,
        "num_floats": 2 * 65 + 1 + 5,  # Two networks 2-16-1, one deviation, five losses.
        "algo": {"normalize_advantage": normalize_advantage},
    }
    with Ranks(tmp_path, sum(map(len, layout)), "check_training", **options).start() as job:
        results = job.results()
    assert [result["error"] for result in results] == [None] * len(results)
    assert len({result["digest"] for result in results}) == 1

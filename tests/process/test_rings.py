"""Steps in which GMIs wait for each other, and one of them ends or stops."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.rank_processes import Ranks


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

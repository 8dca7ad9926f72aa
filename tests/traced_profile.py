"""The profile that `run.profile=2:3` leaves of a training job."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

PROFILED = r"profile of iterations 2 to 3: run/profile/\S*/perfetto_trace\.json\.gz\n"
"""What a job in the folder `run` says of it."""


def check_profile(run: Path) -> None:
    """The iterations that were asked for are in the trace, and no others."""
    [path] = run.glob("profile/plugins/profile/*/perfetto_trace.json.gz")
    events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    found = {e["args"]["step_num"] for e in events if e.get("name") == "iteration"}
    assert found == {"2", "3"}
    summary = json.loads((run / "summary.json").read_text())
    assert summary["profile"]["iterations"] == [2, 3]

"""What the progress of a training job says about its newest line of metrics."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from gmijax.control.console import ConsoleProgress

SYNC = {"env_steps": 500, "env_steps_per_s": 1234.5, "return": 7.25}
EXPERIENCE = {
    **{"async/pps": 2000.0, "async/ttop": 1500.0, "async/staleness_mean": 2.5},
    **{"channel/occupancy": 0.25, "channel/bytes_per_s": 3e6, "channel/dropped": 4},
}


class Lines:
    """A file of metrics with one line."""

    def __init__(self, line: dict[str, Any]) -> None:
        self._line: dict[str, Any] | None = line

    def latest(self) -> dict[str, Any] | None:
        line, self._line = self._line, None
        return line


def said_at_the_end(line: dict[str, Any]) -> str:
    console = Console(file=io.StringIO(), width=300)
    with ConsoleProgress(console, Lines(line).latest, 1000) as progress:
        progress.update(())
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()[-1]


def test_a_synchronous_job_tells_its_rate_and_return():
    said = said_at_the_end(SYNC)
    assert said.startswith("50 %  500 steps  1,234 steps/s  return 7.25")


@pytest.mark.parametrize(
    ("line", "part"),
    [
        (EXPERIENCE, "PPS 2,000  TTOP 1,500  staleness 2.5  channels 25% full, 3 MB/s, 4 dropped"),
        (
            {**EXPERIENCE, "async/staleness_mean": None, "channel/occupancy": None},
            "staleness -  channels - full",
        ),
    ],
)
def test_an_asynchronous_job_tells_of_its_channels(line: dict[str, Any], part: str):
    assert part in said_at_the_end({**SYNC, **line})

"""What a job prints cannot end it; broken programs in the cache are removed."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from supervision import CHECKOUT

from gmijax.control.console import ConsoleProgress, open_console
from gmijax.runs.cache import drop_broken_programs
from gmijax.supervise.gmi_process import GmiStatus

PRINTS = """
from gmijax.control.console import open_console
console = open_console(show=True)
for number in range(200_000):
    console.print(f"line {number}")
open("done", "w").close()
"""


@pytest.mark.parametrize("shell", ["{0} | head -n 1", "{0} >&-", "{0} > /dev/full"])
def test_a_reader_that_is_gone_does_not_end_the_job(tmp_path: Path, shell: str):
    (tmp_path / "prints.py").write_text(PRINTS.replace("200_000", "20_000"))
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {shell.format(f'{sys.executable} prints.py')}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "done").exists()


def test_names_in_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]):
    open_console(show=True).print("runs/[lr=0.1] a[/b]", markup=False)
    assert capsys.readouterr().out == "runs/[lr=0.1] a[/b]\n"


def test_a_display_that_fails_is_given_up(capsys: pytest.CaptureFixture[str]):
    def broken() -> None:
        raise RuntimeError("off")

    progress = ConsoleProgress(open_console(show=True), broken, 100)
    for _ in range(2):
        progress.update((GmiStatus(0, "running", 1, 1, None),))
    assert capsys.readouterr().out == "no progress from here on: RuntimeError('off')\n"


def test_programs_that_could_not_be_read_are_removed(tmp_path: Path):
    cache, log = tmp_path / "cache", tmp_path / "stderr.log"
    cache.mkdir()
    for name in ("jit_step-0a-cache", "jit_step-0b-cache", "jit_step_two-0c-cache"):
        (cache / name).touch()
    log.write_text(
        "x.py:782: UserWarning: Error reading persistent compilation cache entry for 'jit_step': "
        "ZstdError: zstd decompress error\n  warnings.warn(\n"
    )
    assert drop_broken_programs(cache, [log, tmp_path / "none"]) == 2
    assert [path.name for path in cache.iterdir()] == ["jit_step_two-0c-cache"]


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

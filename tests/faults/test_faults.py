"""Some kinds of faults, and all of them once where slow tests run.

`GMIJAX_FAULT_SEEDS=7,8 pytest -m '' tests/faults/test_faults.py` draws more decks, from
these seeds; a failure prints the report of the job and keeps its folder. Every start of a job
costs five seconds.
"""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from fault_jobs import kinds_here, run_job, undisturbed
from fault_plan import KINDS, Fault, draw_jobs, place_faults

SEEDS = (0, *map(int, filter(None, os.environ.get("GMIJAX_FAULT_SEEDS", "").split(","))))
QUICK = (
    ("stdout_gone", "slow", "kill_named", "raise_part", "term_all", "checkpoint_byte"),
    ("stdout_closed", "stop", "nan", "disk_full"),
)
JOBS = (
    *(place_faults(kinds, random.Random(0)) for kinds in QUICK),
    *(job for seed in SEEDS for job in draw_jobs(seed, len(KINDS), tuple(KINDS))),
)


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """What a job learns that nothing happens to."""
    return undisturbed(tmp_path_factory.mktemp("undisturbed"))


def test_a_deck_has_every_kind_once():
    drawn = [fault.kind for job in JOBS[len(QUICK) :] for fault in job]
    assert sorted(drawn) == sorted([*KINDS] * len(SEEDS))


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "job",
    [
        pytest.param(
            job,
            id=f"{number}-" + "-".join(fault.kind for fault in job),
            marks=() if number < len(QUICK) else pytest.mark.slow,
        )
        for number, job in enumerate(JOBS)
    ],
)
def test_a_job_gets_over_its_faults(
    job: list[Fault], tmp_path: Path, expected: list[np.ndarray]
) -> None:
    here = kinds_here()
    report = run_job([fault for fault in job if fault.kind in here], tmp_path, expected)
    assert report.is_good, report
    shutil.rmtree(tmp_path)
    if skipped := [fault.kind for fault in job if fault.kind not in here]:
        pytest.skip(f"the others passed; may not mount, which {skipped} need")

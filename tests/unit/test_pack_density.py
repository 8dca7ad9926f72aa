"""How many jobs at once: the rule against machines whose throughput is known."""

from __future__ import annotations

import random
from collections.abc import Mapping

import pytest

from gmijax.sweeps.density import ConcurrencySearch, JobProgress

SATURATING = {1: 1.0, 2: 1.91, 4: 3.16, 8: 3.84}  # mjlab on an H100.
PEAKED = {1: 1.0, 2: 1.85, 3: 2.4, 4: 2.8, 6: 2.3, 8: 1.8}  # Cores run out.
FLAT = {1: 1.0, 2: 1.01, 4: 1.0, 8: 0.93}


def found_by(
    density: ConcurrencySearch, curve: Mapping[int, float], noise: float = 0.03
) -> list[str]:
    """Runs jobs that never end; returns the reasons of all changes."""
    draw = random.Random(0)
    jobs: dict[int, list[float]] = {}
    why, started, now_s = [], 0, 0.0
    while not density.is_settled and now_s < 5_000:
        while len(jobs) < density.target:
            jobs[started] = [0.0, 0.0]
            started += 1
        for job in jobs.values():
            job[0] += curve[len(jobs)] / len(jobs) * draw.gauss(1, noise)
            job[1] += 1
        now_s += 1.0
        seen = {
            number: JobProgress(done, int(reports)) for number, (done, reports) in jobs.items()
        }
        if (decision := density.look(now_s, seen)) is not None:
            why.append(decision.why)
            for number in sorted(jobs)[decision.target :]:
                del jobs[number]
    return why


@pytest.mark.parametrize(
    ("curve", "most", "best"),
    [
        (SATURATING, 8, 8),
        (SATURATING, 4, 4),
        (PEAKED, 8, 4),
        (FLAT, 8, 1),
        ({1: 1.0, 2: 1.6, 4: 1.5}, 8, 2),
        ({1: 1.0, 2: 1.5, 4: 1.8, 6: 1.85, 8: 1.85}, 8, 4),
        ({1: 1.0, 2: 1.3, 3: 1.2}, 3, 2),
        ({1: 1.0, 2: 1.9, 3: 2.8}, 3, 3),
        ({1: 1.0}, 1, 1),
    ],
)
def test_the_best_number_is_found(curve: Mapping[int, float], most: int, best: int):
    density = ConcurrencySearch(most)
    found_by(density, curve)
    assert density.is_settled
    assert density.target == best


def test_a_step_too_far_is_taken_back_and_says_why():
    assert any("at once make 0." in text for text in found_by(ConcurrencySearch(8), PEAKED))


def test_nothing_is_measured_before_all_are_warm():
    density = ConcurrencySearch(8)
    for second in range(100):
        assert density.look(float(second), {0: JobProgress(float(second), 2)}) is None
    assert density.measured == {}


def test_a_job_that_ends_starts_the_measurement_anew():
    density = ConcurrencySearch(8)
    for second in range(100):
        density.look(float(second), {second // 10: JobProgress(float(second), 3 + second)})
    assert density.measured == {}


def test_what_cannot_run_is_not_tried_again():
    density = ConcurrencySearch(8)
    density.target = 4
    decision = density.forbid(4, "job 3 ran out of memory")
    assert decision is not None
    assert decision.target == density.most == 3
    assert density.is_settled

"""Algorithm 2: every rule, with formulas in place of training jobs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import pytest

from benchmarks.run import RESULTS
from gmijax.autotune.grid import Grid, Measured, NotRunnable, Point, coarse, neighbours
from gmijax.autotune.search import (
    Outcome,
    OutOfBudget,
    Profile,
    Rules,
    estimate,
    saturation,
    search,
)


def on(num_gpus: int) -> Callable[[Point, Measured], float]:
    """Projects to so many GPUs."""
    return lambda point, one: estimate(point.gmis_per_gpu, num_gpus, one)


PAPER = Grid(tuple(range(10, 0, -1)), tuple(128 * 2**i for i in range(8)), ("jax",))
AS_PRINTED = Rules(on(1), alpha=0.1, tolerance=0.0, coarse_first=False)
COARSE = AS_PRINTED._replace(coarse_first=True, tolerance=0.02)


def measured(env_steps_per_s: float, memory_mib: float = 100.0, **more: float) -> Measured:
    return Measured(env_steps_per_s, memory_mib, **{"iteration_s": 1.0, **more})


def gpu(point: Point) -> Measured:
    """A GPU with a fixed price of a step: 2.6 ms + 0.34 us x environments, MPS fills the gaps."""
    alone = point.num_envs / (2.6e-3 + 0.34e-6 * point.num_envs)
    return measured(min(alone, 2.7e6 / point.gmis_per_gpu), 80.0 + 0.05 * point.num_envs)


def points(outcome: Outcome) -> list[tuple[int, int]]:
    return [(one.point.gmis_per_gpu, one.point.num_envs) for one in outcome.visited]


def row(*values: float | None, memory: tuple[float, ...] = (100, 200, 400, 800)) -> Profile:
    """One GMI, sizes 1, 2, 4, 8: throughput by size, None where it cannot run."""

    def profile(point: Point) -> Measured | NotRunnable:
        at = int(math.log2(point.num_envs))
        value = values[at]
        return NotRunnable("out of memory") if value is None else measured(value, memory[at])

    return profile


ONE_ROW = Grid((1,), (1, 2, 4, 8), ("jax",))


def test_as_printed_rows_go_from_most_gmis_and_sizes_up():
    seen = points(search(PAPER, gpu, AS_PRINTED))
    assert [k for k, _ in seen] == sorted((k for k, _ in seen), reverse=True)
    assert seen[0] == (10, 128)
    for gmis in range(1, 11):
        sizes = [n for k, n in seen if k == gmis]
        assert sizes == list(PAPER.num_envs[: len(sizes)])


def test_saturation_ends_a_row():
    # Memory doubles each time. 100 -> 150 is Sat 0.5; 150 -> 160 is 0.067, below alpha.
    outcome = search(ONE_ROW, row(100, 150, 160, 1000), AS_PRINTED)
    assert [n for _, n in points(outcome)] == [1, 2, 4]
    sats = [one.saturation for one in outcome.visited]
    assert sats[0] is None
    assert sats[1:] == pytest.approx([0.5, 10 / 150])


def test_the_point_that_saturates_is_a_candidate():
    outcome = search(ONE_ROW, row(100, 150, 160, 1000), AS_PRINTED)
    assert outcome.best
    assert outcome.best.point.num_envs == 4


def test_a_higher_alpha_stops_earlier():
    outcome = search(ONE_ROW, row(100, 150, 160, 1000), AS_PRINTED._replace(alpha=0.6))
    assert [n for _, n in points(outcome)] == [1, 2]


def test_what_cannot_run_is_skipped_and_recorded():
    outcome = search(ONE_ROW, row(100, None, 300, None), AS_PRINTED)
    assert [n for _, n in points(outcome)] == [1, 2, 4, 8]
    assert outcome.visited[1].result == NotRunnable("out of memory")
    assert outcome.best
    assert outcome.best.point.num_envs == 4
    # Against the last that ran: throughput x 3, memory x 4.
    assert outcome.visited[2].saturation == pytest.approx(2 / 3)


def test_the_first_that_runs_is_a_candidate_even_alone():
    outcome = search(ONE_ROW, row(None, 70, None, None), AS_PRINTED)
    assert outcome.best
    assert outcome.best.point == Point(1, 2, "jax")


def test_where_nothing_runs_there_is_no_answer():
    outcome = search(ONE_ROW, row(None, None, None, None), AS_PRINTED)
    assert outcome.best is None
    assert outcome.complete


@pytest.mark.parametrize(
    ("top", "memory", "sat"),
    [(150, 200, 0.5), (150, 100, math.inf), (150, 50, math.inf), (100, 100, 0.0), (50, 50, 0.0)],
)
def test_saturation(top: float, memory: float, sat: float):
    assert saturation(measured(100, 100), measured(top, memory)) == sat


def test_estimate_is_gmis_times_gpus_times_throughput():
    assert estimate(4, 1, measured(100.0, reduce_s=0.2)) == 400
    assert estimate(4, 2, measured(100.0)) == 800
    assert estimate(1, 2, measured(100.0)) == 200


def test_estimate_charges_the_larger_exchange():
    # t = 4: 2 x 3/4; on two GPUs 2 x 7/8: the exchange grows by 7/6, 0.3 s to 0.35 s.
    slowed = 800 * 1.0 / 1.05
    assert estimate(4, 2, measured(100.0, reduce_s=0.3)) == pytest.approx(slowed)


def test_the_best_for_many_gpus_may_be_another():
    def profile(point: Point) -> Measured:
        if point.gmis_per_gpu == 1:
            return measured(390.0)
        return measured(200.0, reduce_s=0.8)

    grid = Grid((2, 1), (1,), ("jax",))
    for num_gpus, gmis in ((1, 2), (4, 1)):
        found = search(grid, profile, AS_PRINTED._replace(estimate=on(num_gpus))).best
        assert found
        assert found.point.gmis_per_gpu == gmis


def test_one_gmi_wins_where_several_bring_nothing():
    def profile(point: Point) -> Measured:
        gmis, num_envs = point.gmis_per_gpu, point.num_envs
        return measured(1e6 * num_envs / 16384 / gmis * 1.01**gmis, num_envs)

    grid = PAPER._replace(gmis_per_gpu=(2, 1))
    assert search(grid, profile, AS_PRINTED).best != search(grid, profile, COARSE).best
    best = search(grid, profile, COARSE).best  # 1 % faster with two: no difference.
    assert best
    assert best.point == Point(1, 16384, "jax")


def test_the_coarse_search_finds_what_the_whole_grid_has():
    everything, coarse_first = search(PAPER, gpu, AS_PRINTED), search(PAPER, gpu, COARSE)
    assert everything.best
    assert coarse_first.best
    assert coarse_first.best.projected >= 0.97 * everything.best.projected
    assert len(coarse_first.visited) < len(everything.visited) / 2


def test_the_coarse_grid_keeps_one_gmi_and_the_largest_size():
    assert coarse(PAPER) == Grid((1, 4, 7, 10), (2048, 16384), ("jax",))
    assert coarse(Grid((3,), (64,), ("jax", "warp"))) == Grid((3,), (64,), ("jax", "warp"))


def test_the_climb_ends_at_a_top_whose_neighbours_are_lower():
    def hill(point: Point) -> Measured:
        gmis_per_gpu, num_envs, impl, _ = point
        height = 100 - 3 * abs(gmis_per_gpu - 6) - 10 * abs(math.log2(num_envs / 1024))
        return measured(height / gmis_per_gpu, num_envs) if impl == "jax" else measured(1.0)

    outcome = search(PAPER._replace(impls=("jax", "warp")), hill, COARSE._replace(tolerance=0))
    assert outcome.best
    assert outcome.best.point == Point(6, 1024, "jax")
    assert len(points(outcome)) == len(set(outcome.visited))
    around = neighbours(outcome.best.point, PAPER)
    assert len(around) == 4
    assert set(around) <= {one.point for one in outcome.visited}


def test_no_point_is_climbed_to_behind_the_end_of_its_row():
    # Row 5 is saturated at 2048, where it is better than anything else.
    def profile(point: Point) -> Measured:
        gmis_per_gpu, num_envs, _, _ = point
        if gmis_per_gpu == 5:
            return measured(120.0 if num_envs == 2048 else 119.0, num_envs)
        return measured(100.0 if (gmis_per_gpu, num_envs) == (4, 2048) else 1.0, num_envs)

    seen = points(search(PAPER, profile, COARSE._replace(tolerance=0.0)))
    assert (5, 1024) in seen
    assert max(n for k, n in seen if k == 5) == 4096


def test_smaller_sizes_are_looked_at_when_no_larger_one_runs():
    def profile(point: Point) -> Measured | NotRunnable:
        if point.num_envs > 512:
            return NotRunnable("out of memory")
        return measured(100.0 * point.num_envs, point.num_envs)

    outcome = search(PAPER, profile, COARSE)
    assert outcome.best
    assert outcome.best.point.num_envs == 512


def test_out_of_budget_ends_with_what_there_is():
    calls = 0

    def profile(point: Point) -> Measured:
        nonlocal calls
        calls += 1
        if calls > 2:
            raise OutOfBudget
        return gpu(point)

    outcome = search(PAPER, profile, COARSE)
    assert not outcome.complete
    assert len(outcome.visited) == 2
    assert outcome.best
    assert outcome.best.point == Point(1, 16384, "jax")


def test_rows_differ_in_trainers_too():
    """A row has a number of agents and of trainers: Sat compares sizes of the same row only."""

    def profile(point: Point) -> Measured:
        return measured(point.num_envs / point.trainers, 100.0 * point.num_envs)

    grid = Grid((2, 1), (1, 2), ("jax",), trainers=(1, 3))
    outcome = search(grid, profile, AS_PRINTED)
    assert len(outcome.visited) == 8
    assert [one.saturation for one in outcome.visited] == [None, 1.0] * 4
    assert outcome.best
    assert outcome.best.point == Point(2, 2, "jax", 1)
    assert str(outcome.best.point) == "2 + 1 x 2, jax"
    assert str(Point(2, 2, "jax")) == "2 x 2, jax"


def test_the_climb_goes_along_trainers_too():
    def hill(point: Point) -> Measured:
        height = 100 - 3 * abs(point.gmis_per_gpu - 6) - 10 * abs(point.trainers - 2)
        return measured(height / point.gmis_per_gpu, point.num_envs)

    grid = Grid(tuple(range(1, 11)), (64,), ("jax",), trainers=(1, 2, 3, 4))
    found = search(grid, hill, COARSE._replace(tolerance=0.0))
    assert coarse(grid).trainers == (1, 4)
    assert found.best
    assert found.best.point == Point(6, 64, "jax", 2)
    assert len(found.visited) < 40 / 2


def test_of_equals_the_one_with_the_fewest_gmis_wins_trainers_included():
    def profile(point: Point) -> Measured:
        return measured(100.0 / point.gmis_per_gpu)

    grid = Grid((1, 2), (1,), ("jax",), trainers=(1, 2))
    found = search(grid, profile, AS_PRINTED).best
    assert found
    assert found.point == Point(1, 1, "jax", 1)


def test_sat_goes_by_what_the_job_gains():
    """Here trainers learn no faster from more, but agents make more, so fewer must act."""

    def profile(point: Point) -> Measured:
        return measured(100.0, point.num_envs, acting_per_s=100.0 * point.num_envs)

    grid = Grid((1,), (1, 2, 4), ("jax",), trainers=(1,))
    assert len(search(grid, profile, AS_PRINTED).visited) == 2
    whole = search(grid, profile, AS_PRINTED._replace(top=lambda one: one.acting_per_s))
    assert [one.saturation for one in whole.visited] == [None, 1.0, 1.0]


def test_the_faster_implementation_is_part_of_the_answer():
    def profile(point: Point) -> Measured:
        one = gpu(point)
        factor = 2 if point.impl == "warp" else 1
        return one._replace(env_steps_per_s=factor * one.env_steps_per_s)

    outcome = search(PAPER._replace(impls=("jax", "warp")), profile, COARSE)
    assert outcome.best
    assert outcome.best.point.impl == "warp"
    # The slower one is left alone after the first row.
    assert [k for one in outcome.visited if one.point.impl == "jax" for k in one.point[:1]] == [
        1,
        1,
    ]


def test_an_implementation_that_is_nearly_as_fast_is_looked_at_too():
    def profile(point: Point) -> Measured:
        factor = 1.05 if point.impl == "warp" else 1.0
        one = gpu(point)
        return one._replace(env_steps_per_s=factor * one.env_steps_per_s)

    outcome = search(PAPER._replace(impls=("jax", "warp")), profile, COARSE)
    assert {one.point.gmis_per_gpu for one in outcome.visited if one.point.impl == "jax"} > {1}


def test_points_of_an_h200_give_the_same_answer_with_fewer_profiles():
    """What was measured there when no implementation was left out."""
    rows = json.loads((RESULTS / "search-ant-jax-warp-h200.json").read_text())
    known = {
        Point(row["gmis_per_gpu"], row["num_envs"], row["impl"]): row for row in rows["points"]
    }

    def profile(point: Point) -> Measured:
        row = known[point]
        return measured(row["env_steps_per_s"], row["memory_mib"])

    rules = COARSE._replace(alpha=rows["search"]["alpha"], tolerance=rows["search"]["tolerance"])
    outcome = search(PAPER._replace(impls=("jax", "warp")), profile, rules)
    assert outcome.best
    assert outcome.best.point == Point(7, 16384, "warp")
    assert len(outcome.visited) == len(known) - 6

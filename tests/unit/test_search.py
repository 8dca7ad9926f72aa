"""Algorithm 2: every rule, with formulas in place of training jobs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from gmijax.autotune.grid import Grid, Measured, NotRunnable, Point, coarse, neighbours
from gmijax.autotune.search import (
    OutOfBudget,
    Profile,
    Rules,
    SearchOutcome,
    SearchPoint,
    estimate,
    saturation,
    search,
)
from gmijax.baselines import algorithm2
from gmijax.errors import ConfigError


def on(num_gpus: int) -> Callable[[Point, Measured], float]:
    """Projects to so many GPUs."""
    return lambda point, one: estimate(point.gmis_per_gpu, num_gpus, one)


PAPER = Grid(tuple(range(10, 0, -1)), tuple(128 * 2**i for i in range(8)), ("jax",))


def of_one(one: Measured) -> float:
    """The paper's `top`."""
    return one.env_steps_per_s


RULES = Rules(on(1), of_one)


def measured(env_steps_per_s: float, memory_mib: float = 100.0, **more: float) -> Measured:
    return Measured(env_steps_per_s, memory_mib, **{"iteration_s": 1.0, **more})


def gpu(point: Point) -> Measured:
    """A GPU with a fixed price of a step: 2.6 ms + 0.34 us x environments, MPS fills the gaps."""
    alone = point.num_envs / (2.6e-3 + 0.34e-6 * point.num_envs)
    return measured(min(alone, 2.7e6 / point.gmis_per_gpu), 80.0 + 0.05 * point.num_envs)


def best(outcome: SearchOutcome) -> SearchPoint:
    assert outcome.best is not None
    return outcome.best


def points(outcome: SearchOutcome) -> list[tuple[int, int]]:
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
    seen = points(algorithm2.search(PAPER, gpu, RULES))
    assert [k for k, _ in seen] == sorted((k for k, _ in seen), reverse=True)
    assert seen[0] == (10, 128)
    for gmis in range(1, 11):
        sizes = [n for k, n in seen if k == gmis]
        assert sizes == list(PAPER.num_envs[: len(sizes)])


@pytest.mark.parametrize(
    ("values", "sizes", "sats", "best"),
    [
        # Memory doubles each time: 150 -> 160 is Sat 0.067; the point that saturates is none.
        ((100, 150, 160, 1000), [1, 2, 4], [0.5, 10 / 150], 2),
        # What cannot run is skipped: against the last that ran, throughput x 3, memory x 4.
        ((100, None, 300, None), [1, 2, 4, 8], [2 / 3], 4),
        # The first that runs is no candidate, even where it is the best.
        ((100, 130, None, None), [1, 2, 4, 8], [0.3], 2),
        ((None, None, None, None), [1, 2, 4, 8], [], None),
    ],
)
def test_a_row_as_it_is_printed(
    values: tuple[float | None, ...], sizes: list[int], sats: list[float], best: int | None
):
    outcome = algorithm2.search(ONE_ROW, row(*values), RULES)
    assert outcome.complete
    assert [n for _, n in points(outcome)] == sizes
    found = [one.saturation for one in outcome.visited if one.saturation is not None]
    assert found == pytest.approx(sats)
    refused = [one for one in outcome.visited if isinstance(one.result, NotRunnable)]
    assert [one.point.num_envs for one in refused] == [
        size for size, value in zip(ONE_ROW.num_envs, values, strict=True) if value is None
    ]
    assert (outcome.best and outcome.best.point.num_envs) == best


def test_a_row_of_one_point_has_no_candidate_as_printed():
    with pytest.raises(ConfigError, match=r"search\.order=as_printed: no point is a candidate"):
        algorithm2.search(ONE_ROW, row(70, None, None, None), RULES)
    assert best(search(ONE_ROW, row(70, None, None, None), RULES)).point.num_envs == 1


def test_time_that_is_over_ends_the_printed_search_with_what_was_found():
    def profile(point: Point) -> Measured:
        if point.num_envs == 4:
            raise OutOfBudget
        return measured(100.0 * point.num_envs, point.num_envs)

    outcome = algorithm2.search(ONE_ROW, profile, RULES)
    assert not outcome.complete
    assert best(outcome).point.num_envs == 2


@pytest.mark.parametrize(
    ("top", "memory", "sat"),
    [(150, 200, 0.5), (150, 100, math.inf), (150, 50, math.inf), (100, 100, 0.0), (50, 50, 0.0)],
)
def test_saturation(top: float, memory: float, sat: float):
    assert saturation(measured(100, 100), measured(top, memory), of_one) == sat


def test_estimate_is_gmis_times_gpus_times_throughput_less_the_larger_exchange():
    assert estimate(4, 1, measured(100.0, reduce_s=0.2)) == 400
    assert estimate(4, 2, measured(100.0)) == 800
    assert estimate(1, 2, measured(100.0)) == 200
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
        found = best(search(grid, profile, RULES._replace(estimate=on(num_gpus))))
        assert found.point.gmis_per_gpu == gmis


def test_one_gmi_wins_where_several_bring_nothing():
    def profile(point: Point) -> Measured:
        gmis, num_envs = point.gmis_per_gpu, point.num_envs
        return measured(1e6 * num_envs / 16384 / gmis * 1.01**gmis, num_envs)

    grid = PAPER._replace(gmis_per_gpu=(2, 1))
    assert best(algorithm2.search(grid, profile, RULES)).point == Point(2, 16384, "jax")
    # 1 % faster with two: no difference.
    assert best(search(grid, profile, RULES)).point == Point(1, 16384, "jax")


def test_the_coarse_search_finds_what_the_whole_grid_has():
    everything, coarse_first = algorithm2.search(PAPER, gpu, RULES), search(PAPER, gpu, RULES)
    assert best(coarse_first).projected >= 0.97 * best(everything).projected
    assert len(coarse_first.visited) < len(everything.visited) / 2


def test_the_coarse_grid_keeps_one_gmi_and_the_largest_size():
    assert coarse(PAPER) == Grid((1, 4, 7, 10), (2048, 16384), ("jax",))
    assert coarse(Grid((3,), (64,), ("jax", "warp"))) == Grid((3,), (64,), ("jax", "warp"))


def test_the_climb_ends_at_a_top_whose_neighbours_are_lower():
    def hill(point: Point) -> Measured:
        gmis_per_gpu, num_envs, impl, _ = point
        height = 100 - 3 * abs(gmis_per_gpu - 6) - 10 * abs(math.log2(num_envs / 1024))
        return measured(height / gmis_per_gpu, num_envs) if impl == "jax" else measured(1.0)

    grid = PAPER._replace(impls=("jax", "warp"), trainers=2)
    outcome = search(grid, hill, RULES)
    assert best(outcome).point == Point(6, 1024, "jax", 2)
    assert len(outcome.visited) == len(set(outcome.visited)) < 160 / 4
    around = neighbours(best(outcome).point, grid)
    assert len(around) == 4
    assert set(around) <= {one.point for one in outcome.visited}


def test_no_point_is_climbed_to_behind_the_end_of_its_row():
    # Row 5 is saturated at 2048, where it is better than anything else.
    def profile(point: Point) -> Measured:
        gmis_per_gpu, num_envs, _, _ = point
        if gmis_per_gpu == 5:
            return measured(120.0 if num_envs == 2048 else 115.0, num_envs)
        return measured(100.0 if (gmis_per_gpu, num_envs) == (4, 2048) else 1.0, num_envs)

    seen = points(search(PAPER, profile, RULES))
    assert (5, 1024) in seen
    assert max(n for k, n in seen if k == 5) == 4096


def test_smaller_sizes_are_looked_at_when_no_larger_one_runs():
    def profile(point: Point) -> Measured | NotRunnable:
        if point.num_envs > 512:
            return NotRunnable("out of memory")
        return measured(100.0 * point.num_envs, point.num_envs)

    assert best(search(PAPER, profile, RULES)).point.num_envs == 512


def test_a_point_with_trainers_names_both_numbers():
    assert str(Point(2, 2, "jax", 1)) == "2 + 1 x 2, jax"
    assert str(Point(2, 2, "jax")) == "2 x 2, jax"


def test_sat_goes_by_what_the_job_gains():
    """Here trainers learn no faster from more, but agents make more, so fewer must act."""

    def profile(point: Point) -> Measured:
        rate = 100.0 if point.num_envs == 1 else 150.0
        return measured(rate, point.num_envs, acting_per_s=100.0 * point.num_envs)

    grid = Grid((1,), (1, 2, 4, 8), ("jax",), trainers=1)
    assert len(algorithm2.search(grid, profile, RULES).visited) == 3
    whole = algorithm2.search(grid, profile, RULES._replace(top=lambda one: one.acting_per_s))
    assert [one.saturation for one in whole.visited] == [None, 1.0, 1.0, 1.0]


@pytest.mark.parametrize(("factor", "rows"), [(2.0, {1}), (1.05, {1, 4, 7, 10})])
def test_an_implementation_that_is_clearly_slower_is_left_after_the_first_row(
    factor: float, rows: set[int]
):
    def profile(point: Point) -> Measured:
        one = gpu(point)
        faster = factor if point.impl == "warp" else 1.0
        return one._replace(env_steps_per_s=faster * one.env_steps_per_s)

    outcome = search(PAPER._replace(impls=("jax", "warp")), profile, RULES)
    assert best(outcome).point.impl == "warp"
    assert {p.point.gmis_per_gpu for p in outcome.visited if p.point.impl == "jax"} == rows


def test_points_of_an_h200_give_the_same_answer_with_fewer_profiles():
    """What was measured there when no implementation was left out."""
    rows = json.loads(Path(__file__).with_name("search_points_of_an_h200.json").read_text())
    known = {
        Point(row["gmis_per_gpu"], row["num_envs"], row["impl"]): row for row in rows["points"]
    }

    def profile(point: Point) -> Measured:
        row = known[point]
        return measured(row["env_steps_per_s"], row["memory_mib"])

    outcome = search(PAPER._replace(impls=("jax", "warp")), profile, RULES)
    assert best(outcome).point == Point(7, 16384, "warp")
    assert len(outcome.visited) == len(known) - 6

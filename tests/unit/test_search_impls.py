"""Which physics implementation a search takes."""

from __future__ import annotations

import json

from test_search import COARSE, PAPER, gpu, measured

from benchmarks.run import RESULTS
from gmijax.autotune.grid import Measured, Point
from gmijax.autotune.search import search


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

"""The advice that the measurements add up to, and every other table, so that all have names."""

from __future__ import annotations

from benchmarks.evaluation import (  # noqa: F401  Each registers its tables.
    claims,
    front,
    learning_tables,
    peer_tables,
    seed_tables,
)
from benchmarks.evaluation.async_tables import asynchronous_gains
from benchmarks.evaluation.figures import bounds, shown
from benchmarks.evaluation.pack_tables import packed_gains
from benchmarks.evaluation.plots import mps_gains
from benchmarks.evaluation.sweep_tables import first_gains, program_over_processes
from benchmarks.evaluation.tables import best_plan_ratios, fixed_total_ratios, over_one_gpu
from benchmarks.evaluation.writer import TABLES, Rows, table

__all__ = ["TABLES", "advice"]


@table(
    "advice",
    "you have | several GMIs per GPU? | measured (on H200s with ant, unless said)",
)
def advice() -> Rows:
    """Who gains from GMIs, and who does not."""
    eightfold = first_gains().get("8 at once, auto")
    throughput = first_gains("steady_steps_per_s").get("8 at once, auto")
    program = [
        shown(program_over_processes(key)) for key in ("steady_steps_per_s", "trainings_per_hour")
    ]
    fixed = bounds([*fixed_total_ratios().values()])
    peak = bounds([*best_plan_ratios().values()])
    return [
        [
            *("many small runs on one GPU (seeds, a sweep)", "**yes**: `gmijax sweep`"),
            f"eight runs at once: {shown(throughput)} times the steps/s of one; with start-up, "
            f"which overlaps, {shown(eightfold)} times as many runs of half a minute per hour",
        ],
        [
            *("many runs that differ only in seed and learning rate", "**no**: one program"),
            f"eight runs in one process (`gmijax sweep ... sweep.pack=auto`): {program[0]} times "
            f"the steps/s of eight processes, {program[1]} times the runs per hour (n=1)",
        ],
        [
            *("several trainings of another library on one GPU", "**yes**: `gmijax pack`"),
            packed_gains(),
        ],
        [
            *("several processes on one GPU anyway", "**yes**, under MPS"),
            f"{bounds([*mps_gains().values()])} times the steps/s of plain sharing "
            "(serving ant and humanoid, 2 to 8 GMIs)",
        ],
        [
            *("one large synchronous training run on one GPU", "**no** (the default)"),
            f"{fixed} times the steps/s of one process with as many environments; each side "
            f"at its best number of environments, six tasks on H100s: {peak}",
        ],
        [
            *("one training run on several GPUs", "one GMI on each"),
            f"four GPUs reach {shown(over_one_gpu(4))} times the steps/s of one",
        ],
        [
            *("asynchronous training", "try synchronous training first"),
            f"{bounds(asynchronous_gains(1))} times the steps/s of synchronous training on one "
            f"GPU, {bounds(asynchronous_gains(2))} on two (H100s, 100M steps)",
        ],
    ]

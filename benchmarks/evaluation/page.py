"""Every table that documents can have, by name, and the advice that they add up to."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

from benchmarks.evaluation.async_tables import ASYNC_TABLES, asynchronous_gains
from benchmarks.evaluation.claims import claims
from benchmarks.evaluation.figures import bounds, markdown, shown
from benchmarks.evaluation.front import front
from benchmarks.evaluation.other_tables import OTHER_TABLES
from benchmarks.evaluation.pack_tables import packed_gains, packs
from benchmarks.evaluation.peer_tables import peers
from benchmarks.evaluation.plots import mps_gains
from benchmarks.evaluation.seed_tables import brax_returns, playground, playground_seeds, seeds
from benchmarks.evaluation.sweep_tables import first_gains, program_over_processes, sweeps
from benchmarks.evaluation.tables import (
    TRAINING_TABLES,
    best_plan_ratios,
    fixed_total_ratios,
    over_one_gpu,
)


def advice() -> list[str]:
    """Who gains from GMIs, and who does not."""
    eightfold = first_gains().get("8 at once, auto")
    throughput = first_gains("steady_steps_per_s").get("8 at once, auto")
    program = [
        shown(program_over_processes(key)) for key in ("steady_steps_per_s", "trainings_per_hour")
    ]
    fixed = bounds([*fixed_total_ratios().values()])
    peak = bounds([*best_plan_ratios().values()])
    rows = [
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
    head = "you have | several GMIs per GPU? | measured (on H200s with ant, unless said)"
    return markdown(head, rows)


TABLES: MappingProxyType[str, Callable[[], list[str]]] = MappingProxyType(
    {
        "advice": advice,
        "front": front,
        "claims": claims,
        "packs": packs,
        "peers": peers,
        "sweeps": sweeps,
        "seeds": seeds,
        "playground": playground,
        "playground-seeds": playground_seeds,
        "brax-returns": brax_returns,
        **TRAINING_TABLES,
        **ASYNC_TABLES,
        **OTHER_TABLES,
    }
)
"""By the name that documents use: `<!-- table: NAME -->`."""

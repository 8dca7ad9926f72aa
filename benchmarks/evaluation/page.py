"""Every table that documents can have, by name, and the advice that they add up to."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

from benchmarks.evaluation.claims import claims
from benchmarks.evaluation.figures import bounds, markdown, ratio, shown
from benchmarks.evaluation.other_tables import OTHER_TABLES
from benchmarks.evaluation.peer_tables import peers
from benchmarks.evaluation.plots import summary
from benchmarks.evaluation.sweep_tables import same_trainings, sweeps
from benchmarks.evaluation.tables import (
    TRAINING_TABLES,
    fixed_total_ratios,
    small_gmis,
)


def advice() -> list[str]:
    """Who gains from GMIs, and who does not."""
    small = small_gmis()
    tenfold = small[10] / small[1] if {1, 10} <= small.keys() else None
    gains = next((same.gains() for same in same_trainings().values()), {})
    eightfold = gains.get("8 at once, auto")
    sharing = [gain for name, gain in summary().items() if name.startswith("MPS")]
    fixed = bounds([*fixed_total_ratios().values()])
    over_one = ratio("scaling", "4 GPUs x 1 GMIs x 8192", "1 GPUs x 1 GMIs x 8192")
    rows = [
        [
            *("many small trainings on one GPU (seeds, a sweep)", "**yes**: `gmijax.sweep`"),
            f"eight trainings at once: {shown(eightfold)} times the trainings per hour of one "
            f"after another{'' if eightfold and eightfold.repeats > 1 else ' (1 sweep of each)'}; "
            f"ten GMIs: {shown(tenfold)} times the steps/s of one",
        ],
        [
            *("several processes on one GPU anyway", "**yes**, under MPS"),
            f"{bounds(sharing)} times the steps/s of plain sharing "
            "(serving ant and humanoid, 2 to 8 GMIs)",
        ],
        [
            *("one large synchronous training on one GPU", "**no**: `plan.gmis_per_gpu=1`"),
            f"{fixed} times the steps/s of one process with as many environments",
        ],
        [
            *("one training on several GPUs", "one GMI on each"),
            f"four GPUs make {shown(over_one)} times the steps/s of one",
        ],
        [
            *("asynchronous training", "try synchronous training first"),
            "slower on one GPU; runs on more were too short to tell",
        ],
    ]
    return markdown("you have | GMIs | measured on NVIDIA H200s, ant", rows)


TABLES: MappingProxyType[str, Callable[[], list[str]]] = MappingProxyType(
    {
        "advice": advice,
        "claims": claims,
        "peers": peers,
        "sweeps": sweeps,
        **TRAINING_TABLES,
        **OTHER_TABLES,
    }
)
"""By the name that documents use: `<!-- table: NAME -->`."""

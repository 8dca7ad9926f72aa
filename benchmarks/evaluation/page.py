"""What the measurements add up to: the advice, and the figures of the front page.

Their words are in `advice.md` and `front.md`. Importing this registers every table.
"""

from __future__ import annotations

from benchmarks.evaluation import claims, learning_tables, seed_tables  # noqa: F401
from benchmarks.evaluation.async_tables import asynchronous_gains
from benchmarks.evaluation.figures import NOT_MEASURED, Figure, bounds, shown
from benchmarks.evaluation.learning_tables import seconds_to_mark, seconds_until_it_walks
from benchmarks.evaluation.other_tables import seconds_to_recover
from benchmarks.evaluation.pack_tables import CLEANRL, MJLAB, eight_packed
from benchmarks.evaluation.peer_tables import over_brax
from benchmarks.evaluation.plots import mps_gains
from benchmarks.evaluation.sweep_tables import first_gains, program_over_processes
from benchmarks.evaluation.tables import best_plan_ratios, fixed_total_ratios, over_one_gpu
from benchmarks.evaluation.writer import TABLES, filled, lines

__all__ = ["TABLES", "advice"]

EIGHT = "8 at once, auto"


@lines("advice")
def advice() -> list[str]:
    """Who gains from GMIs, and who does not."""
    return filled(
        "advice",
        eight_steps=shown(first_gains("steady_steps_per_s").get(EIGHT)),
        eight_finished=shown(first_gains().get(EIGHT)),
        program=program_over_processes(),
        mjlab=eight_packed(MJLAB),
        cleanrl=eight_packed(CLEANRL),
        mps=bounds([*mps_gains().values()]),
        fixed_total=bounds([*fixed_total_ratios().values()]),
        best_plans=bounds([*best_plan_ratios().values()]),
        two_gpus=shown(over_one_gpu(2)),
        four_gpus=shown(over_one_gpu(4)),
        asynchronous_1=bounds(asynchronous_gains(1)),
        asynchronous_2=bounds(asynchronous_gains(2)),
    )


@lines("front")
def front() -> list[str]:
    """What was measured, on which GPU, each with a link to the section that has its file."""
    beside = [value for value in over_brax() if value is not None]
    return filled(
        "front",
        ant=_of(seconds_to_mark("ant"), ".1f"),
        go1=_of(seconds_until_it_walks("go1"), ".0f"),
        eight=_of(first_gains("steady_steps_per_s").get(EIGHT), ".2f"),
        mjlab=eight_packed(MJLAB),
        cleanrl=eight_packed(CLEANRL),
        over_brax=bounds(beside),
        comparisons=str(len(beside)),
        kill=_of(seconds_to_recover().get("kill"), ".0f"),
    )


def _of(found: Figure | None, form: str) -> dict[str, str]:
    """A median, and how many runs it is of."""
    if found is None:
        return {"median": NOT_MEASURED, "runs": "0 runs"}
    runs = "1 run" if found.repeats == 1 else f"{found.repeats} runs"
    return {"median": format(found.median, form), "runs": runs}

"""The tables that sum up the measurements: the advice, and the figures of the front page.

Their text is in `advice.md` and `front.md`. Importing this registers every table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from benchmarks.evaluation import claims, learning_tables, seed_tables  # noqa: F401
from benchmarks.evaluation.async_tables import (
    SECONDS,
    asynchronous_gains,
    beside_a_learner,
    learners_over_one,
)
from benchmarks.evaluation.evidence import FigureText, Ratio
from benchmarks.evaluation.figures import TRAINING, Figure, text_of, text_of_range
from benchmarks.evaluation.learning_tables import seconds_to_mark
from benchmarks.evaluation.other_tables import seconds_to_recover
from benchmarks.evaluation.pack_tables import CLEANRL, MJLAB, eight_packed
from benchmarks.evaluation.peer_tables import over_brax
from benchmarks.evaluation.serving_tables import mps_gains
from benchmarks.evaluation.sweep_tables import KEYS as KEYS_OF_SWEEPS
from benchmarks.evaluation.sweep_tables import eight_at_once, processes_over_program
from benchmarks.evaluation.tables import best_plan_ratios, fixed_total_ratios, over_one_gpu
from benchmarks.evaluation.walking_tables import seconds_until_it_walks
from benchmarks.evaluation.writer import TABLES, WORD_TABLES, Values, word_table

__all__ = ["TABLES", "WORD_TABLES"]


STEPS, FINISHED = "steps", "finished"
Gains: TypeAlias = Mapping[str, Sequence[Figure | Ratio | None]]
"""In steps/s, and in trainings that finish: one or several, of several cases."""


def gains() -> dict[str, Gains]:
    """What several GMIs gain or lose, by the names of rows in `advice.md`."""
    eight = {key: [eight_at_once(sweeps)] for key, sweeps in KEYS_OF_SWEEPS.items()}
    program = {key: [processes_over_program(sweeps)] for key, sweeps in KEYS_OF_SWEEPS.items()}
    return {
        "eight": eight,
        "program": program,
        "mjlab": {key: [gain] for key, gain in eight_packed(MJLAB).items()},
        "cleanrl": {key: [gain] for key, gain in eight_packed(CLEANRL).items()},
        "mps": {STEPS: [*mps_gains().values()]},
        "off_policy": {STEPS: beside_a_learner()},
        "fixed_total": {STEPS: [*fixed_total_ratios().values()]},
        "best_plans": {STEPS: [*best_plan_ratios().values()]},
        "two_gpus": {STEPS: [over_one_gpu()]},
        "two_gpus_sac": {STEPS: [learners_over_one()]},
        **{
            f"asynchronous_{gpus}": {
                STEPS: asynchronous_gains(gpus, TRAINING),
                FINISHED: asynchronous_gains(gpus, SECONDS),
            }
            for gpus in (1, 2)
        },
    }


@word_table("advice")
def advice() -> Values:
    """Who gains from GMIs, and who does not."""
    return {
        name: {
            key: text_of(found[0]) if len(found) == 1 else text_of_range(found)
            for key, found in of_row.items()
        }
        for name, of_row in gains().items()
    }


@word_table("front")
def front() -> Values:
    """What was measured, each with a link to the section that has its file."""
    go1, go1_seeds = seconds_until_it_walks("go1", "warp")
    beside = [one for one in over_brax() if one.evidence.is_enough]
    return {
        "ant": text_of(_brief(seconds_to_mark("ant")), ".1f"),
        "go1": text_of(_brief(go1), ".0f"),
        "go1_seeds": FigureText(go1_seeds, None),
        "eight": text_of(eight_at_once(KEYS_OF_SWEEPS[STEPS])),
        "mjlab": {key: text_of(gain) for key, gain in eight_packed(MJLAB).items()},
        "cleanrl": {key: text_of(gain) for key, gain in eight_packed(CLEANRL).items()},
        "over_brax": text_of_range(beside),
        "comparisons": FigureText(str(len(beside)), None),
        "kill": text_of(_brief(seconds_to_recover().get("kill"), "kill"), ".0f"),
    }


def _brief(found: Figure | None, unit: str = "run") -> Ratio | None:
    """Its median alone; the text beside it states how many runs, or other `unit`s, it is from."""
    return found and Ratio(found.median, found.evidence._replace(unit=unit))

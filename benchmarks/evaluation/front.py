"""The figures of the front page, each with a link to the section that has its file."""

from __future__ import annotations

from benchmarks.evaluation.figures import NOT_MEASURED, Figure, bounds
from benchmarks.evaluation.learning_tables import seconds_to_mark
from benchmarks.evaluation.other_tables import seconds_to_recover
from benchmarks.evaluation.pack_tables import packed
from benchmarks.evaluation.peer_tables import over_brax
from benchmarks.evaluation.sweep_tables import first_gains
from benchmarks.evaluation.writer import Rows, table

EVALUATION = "docs/evaluation"
_SECONDS, _TIMES = "s of training", "times the steps/s"


@table("front", "what | measured | on")
def front() -> Rows:
    """What was measured, on which GPU, and where its file is."""
    eight = first_gains("steady_steps_per_s").get("8 at once, auto")
    recovered = seconds_to_recover().get("kill")
    beside = [value for value in over_brax() if value is not None]
    marks, sharing = "learning.md#seconds-to-published-returns", "sharing.md"
    ant, humanoid = (seconds_to_mark(task) for task in ("ant", "humanoid"))
    return [
        _row("`ant` learns to run (return 3,000)", *_of(ant, ".1f", _SECONDS), "H100", marks),
        _row(
            "`humanoid` learns to run (return 5,000)",
            *_of(humanoid, ".1f", _SECONDS),
            "H200",
            marks,
        ),
        _row(
            "eight `ant` trainings at once, compared with one",
            *_of(eight, ".2f", _TIMES),
            *("H200", f"{sharing}#many-small-training-runs"),
        ),
        *(
            _row(
                f"eight trainings of {one.name} (PyTorch) at once, compared with one",
                *(f"{one.steps_per_s:.2f} {_TIMES}", f"{one.repeats} runs"),
                *("H200", f"{sharing}#other-libraries"),
            )
            for one in packed()
        ),
        _row(
            "one training, beside Brax's PPO with the same settings",
            *(f"{bounds(beside)} {_TIMES}", f"{len(beside)} comparisons"),
            *("H100", "speed.md#beside-other-libraries"),
        ),
        _row(
            "recovery after `kill -9` of one of four processes",
            *_of(recovered, ".0f", "s"),
            *("H200", "speed.md#recovery-from-faults"),
        ),
    ]


def _row(what: str, measured: str, runs: str, gpu: str, section: str) -> list[str]:
    return [what, f"[{measured}]({EVALUATION}/{section})", f"{gpu}, {runs}"]


def _of(found: Figure | None, form: str, unit: str) -> tuple[str, str]:
    if found is None:
        return NOT_MEASURED, "0 runs"
    runs = "1 run" if found.repeats == 1 else f"{found.repeats} runs"
    return f"{found.median:{form}} {unit}", runs

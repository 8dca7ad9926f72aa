"""The figures of the paper's claims, whose words are in `claims.md`.

A row is a claim of the preprint (arXiv:2206.08482), of "GMI-DRL: Empowering Multi-GPU DRL with
Adaptive-Grained Parallelism" (USENIX ATC 2025), or of both, and what was measured here. A cell is
empty where a version says nothing new.
"""

from __future__ import annotations

from benchmarks.evaluation.async_tables import KEYS, LONG
from benchmarks.evaluation.figures import NOT_MEASURED, bounds, ratio, results_of, shown
from benchmarks.evaluation.other_tables import (
    IMPLS,
    SERVING,
    USE,
    model_fit,
    mps_and_share,
    mps_over_share,
    serving_rate,
)
from benchmarks.evaluation.paper import LGR, lgr_gain
from benchmarks.evaluation.tables import (
    LAYOUTS,
    TEMPLATES,
    algorithm_1,
    best_plan_ratios,
    fixed_total_ratios,
    reduction_gain,
)
from benchmarks.evaluation.writer import filled, lines


@lines("claims")
def claims() -> list[str]:
    """What both versions of the paper claim, and what was measured here."""
    uses = results_of(USE).get("tasks", {})
    served = results_of(SERVING).get("cases", ())
    several = [mps_and_share("ant", gmis)[0] for gmis in (2, 4, 8)]
    return filled(
        "claims",
        busy=bounds([stage["sm"] for use in uses.values() for stage in use.values()], ".0%"),
        model_fit=model_fit(),
        serving_templates=bounds(
            [one["colocated"] / one["dedicated"] for one in served if "dedicated" in one]
        ),
        templates=bounds([ratio(f"templates-{task}", *TEMPLATES) for task in ("ant", "humanoid")]),
        answers=_answers(),
        several_served=bounds(several, ",.0f"),
        one_serves=shown(serving_rate(SERVING, "ant 1 x 8192, mps"), ",.0f"),
        fixed_total=bounds([*fixed_total_ratios().values()]),
        best_plans=bounds([*best_plan_ratios().values()]),
        mps={task: bounds([mps_over_share(task, n) for n in (2, 4, 8)]) for task in IMPLS},
        environments=bounds(
            [
                ratio(f"tasks-{impl}", f"{task} {impl} 8192", f"{task} {impl} 2048")
                for task in ("ant", "humanoid")
                for impl in ("jax", "warp")
            ]
        ),
        **_reductions(),
        **_asynchronous(),
    )


def _answers() -> str:
    """What the searches on one GPU chose for ant."""
    answers = [
        f"{best['gmis_per_gpu']} x {best['num_envs']:,} ({best['impl']})"
        for file in ("search-ant-jax-h200", "search-ant-one_shot-h200")
        if (best := results_of(file).get("best"))
    ]
    return ", ".join(answers) or NOT_MEASURED


def _reductions() -> dict[str, dict[str, str]]:
    """Of LGR by task, on three layouts."""
    found: dict[str, dict[str, str]] = {"lgr_of_paper": {}, "one_shot": {}, "lgr": {}}
    for task in LGR:
        of_paper = [f"{lgr_gain(task, at):.2f}" for at in LAYOUTS]
        one_shot = [shown(reduction_gain(task, at, "one_shot")) for at in LAYOUTS]
        chosen = [
            f"{way} {shown(reduction_gain(task, at, way))}"
            for at, way in ((at, algorithm_1(at)) for at in LAYOUTS)
        ]
        found["lgr_of_paper"][task] = " ".join(of_paper)
        found["one_shot"][task] = " ".join(one_shot)
        found["lgr"][task] = ", ".join(chosen)
    return found


def _asynchronous() -> dict[str, dict[str, str]]:
    """Of A3C with several GMIs over one on each GPU, and of channels, by key."""
    one_each, several = "3 + 1 GPUs, one process each", "3 + 1 GPUs, 4 agents + 2 trainers"
    pairs = {
        "two": (LONG, "1 + 1 GPUs, 4 agents + 2 trainers", "1 + 1 GPUs, one process each"),
        "four": ("async-4gpu", f"{several}, har, batches of 4 agents", one_each),
        "by_host": ("async-4gpu", several, one_each),
        "channels": ("async-channels", "anymal multi", "anymal uni"),
    }
    return {name: {key: shown(ratio(*pair, key)) for key in KEYS} for name, pair in pairs.items()}

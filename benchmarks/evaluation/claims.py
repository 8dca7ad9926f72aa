"""The figures of the paper's claims, whose words are in `claims.md`.

A row is a claim of the preprint (arXiv:2206.08482), of "GMI-DRL: Empowering Multi-GPU DRL with
Adaptive-Grained Parallelism" (USENIX ATC 2025), or of both, and what was measured here. A cell is
empty where a version says nothing new.
"""

from __future__ import annotations

from benchmarks.cases import REWARD
from benchmarks.evaluation.async_tables import KEYS, LONG, learners_over_one
from benchmarks.evaluation.figures import NOT_MEASURED, bounds, ratio, results_of, shown
from benchmarks.evaluation.learning_tables import seconds_over_one_process
from benchmarks.evaluation.node_tables import two_nodes_over_one
from benchmarks.evaluation.other_tables import USE, answers, model_fit
from benchmarks.evaluation.paper import LGR, lgr_gain
from benchmarks.evaluation.serving_tables import (
    GMIS,
    mps_over_one,
    mps_over_share,
    serving_rate,
    templates_gains,
)
from benchmarks.evaluation.serving_tables import TASKS as SERVED
from benchmarks.evaluation.tables import (
    LAYOUTS,
    TEMPLATES,
    algorithm_1,
    best_plan_ratios,
    busy_in_jobs,
    fixed_total_ratios,
    reduction_gain,
)
from benchmarks.evaluation.writer import filled, lines


@lines("claims")
def claims() -> list[str]:
    """What both versions of the paper claim, and what was measured here."""
    uses = results_of(USE).get("tasks", {})
    rates = [rate.median for n in GMIS if (rate := serving_rate("ant", n))]
    return filled(
        "claims",
        busy=bounds([stage["sm"] for use in uses.values() for stage in use.values()], ".0%"),
        busy_one=bounds(busy_in_jobs(several=False), ".0%"),
        busy_several=bounds(busy_in_jobs(several=True), ".0%"),
        model_fit=model_fit(),
        serving_templates=bounds(templates_gains()),
        templates=bounds([ratio(f"templates-{task}", *TEMPLATES) for task in ("ant", "humanoid")]),
        answers=_answers(),
        served=bounds(rates, ",.0f"),
        served_over_one=bounds([mps_over_one(task, n) for task in SERVED for n in GMIS]),
        fixed_total=bounds([*fixed_total_ratios().values()]),
        best_plans=bounds([*best_plan_ratios().values()]),
        mps={task: bounds([mps_over_share(task, n) for n in GMIS]) for task in SERVED},
        from_512=_more_environments(512, 2048),
        from_2048=_more_environments(2048, 8192),
        learners=shown(learners_over_one()),
        nodes=two_nodes_over_one(),
        reward=", ".join(f"{task} {shown(seconds_over_one_process(task))}" for task in REWARD),
        **_reductions(),
        **_asynchronous(),
    )


def _answers() -> str:
    """What the searches on one GPU chose."""
    found = (
        f"{task} {best['gmis_per_gpu']} x {best['num_envs']:,} ({best['impl']})"
        for task, best in ((task, row["best"]) for task, row in answers().items())
    )
    return ", ".join(found) or NOT_MEASURED


def _more_environments(few: int, many: int) -> str:
    """Steps/s with many environments in one process over those with few."""
    return bounds(
        [
            ratio(f"tasks-{impl}", f"{task} {impl} {many}", f"{task} {impl} {few}")
            for task in ("ant", "humanoid")
            for impl in ("jax", "warp")
        ]
    )


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
        "channels_fc": ("async-channels", "franka_cabinet multi", "franka_cabinet uni"),
    }
    return {name: {key: shown(ratio(*pair, key)) for key in KEYS} for name, pair in pairs.items()}

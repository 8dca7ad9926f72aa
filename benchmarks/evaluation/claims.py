"""The figures of the paper's claims, whose words are in `claims.md`.

A row is a claim of the preprint (arXiv:2206.08482), of "GMI-DRL: Empowering Multi-GPU DRL with
Adaptive-Grained Parallelism" (USENIX ATC 2025), or of both, and what was measured here. A cell is
empty where a version says nothing new.
"""

from __future__ import annotations

from benchmarks.cases import REWARD
from benchmarks.evaluation.async_tables import KEYS, LONG, learners_over_one
from benchmarks.evaluation.evidence import Ratio, Said
from benchmarks.evaluation.figures import TRAINING, joined, ratio, said, said_bounds
from benchmarks.evaluation.learning_tables import said_of_reward
from benchmarks.evaluation.node_tables import two_nodes_over_one
from benchmarks.evaluation.other_tables import model_fit, searched
from benchmarks.evaluation.paper import LGR, lgr_gain
from benchmarks.evaluation.peer_tables import our_rate
from benchmarks.evaluation.serving_tables import (
    GMIS,
    mps_gains,
    mps_over_one,
    of_communication,
    peak_over_peak,
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
from benchmarks.evaluation.writer import Values, words


@words("claims")
def claims() -> Values:
    """What both versions of the paper claim, and what was measured here."""
    return {
        "busy_one": said_bounds(busy_in_jobs(several=False), ".0%"),
        "busy_several": said_bounds(busy_in_jobs(several=True), ".0%"),
        "model_fit": model_fit(),
        "serving_templates": said_bounds(templates_gains()),
        "com": said_bounds(of_communication()),
        "templates": said_bounds([ratio(*cases) for cases in TEMPLATES.values()]),
        "search": searched(),
        "served_at_peak": said_bounds([peak_over_peak(task) for task in SERVED]),
        "served_over_one": said_bounds([mps_over_one(task, n) for task in SERVED for n in GMIS]),
        "fixed_total": said_bounds([*fixed_total_ratios().values()]),
        "best_plans": said_bounds([*best_plan_ratios().values()]),
        "mps": {name: said(gain) for name, gain in mps_gains().items()},
        "from_512": _more_environments(512, 2048),
        "from_2048": _more_environments(2048, 8192),
        "memory": _more_environments(2048, 8192, "device/peak_memory_mib"),
        "learners": said(learners_over_one()),
        "nodes": two_nodes_over_one(),
        "reward": {task: said_of_reward(task) for task in REWARD},
        "humanoid": said(our_rate("humanoid, MJX-Warp"), ",.0f"),
        **_reductions(),
        **_asynchronous(),
    }


def _named(name: str, gain: Ratio | None) -> Said:
    found = said(gain)
    return Said(f"{name} {found}", found.evidence)


def _more_environments(few: int, many: int, key: str = TRAINING) -> Said:
    """Steps/s, or memory, with many environments in one process over those with few."""
    return said_bounds(
        [
            ratio("tasks-warp", f"{task} warp {many}", f"{task} warp {few}", key)
            for task in ("ant", "humanoid")
        ]
    )


def _reductions() -> dict[str, dict[str, Said]]:
    """Of LGR by task, on three layouts."""
    found: dict[str, dict[str, Said]] = {"lgr_of_paper": {}, "one_shot": {}, "lgr": {}}
    for task in LGR:
        of_paper = [f"{lgr_gain(task, at):.2f}" for at in LAYOUTS]
        one_shot = (said(reduction_gain(task, at, "one_shot")) for at in LAYOUTS)
        chosen = (
            _named(f"`{way}`", reduction_gain(task, at, way))
            for at, way in ((at, algorithm_1(at)) for at in LAYOUTS)
        )
        found["lgr_of_paper"][task] = Said(", ".join(of_paper), None)
        found["one_shot"][task] = joined(", ", one_shot)
        found["lgr"][task] = joined(", ", chosen)
    return found


def _asynchronous() -> dict[str, dict[str, Said]]:
    """Of A3C with several GMIs over one on each GPU, and of channels, by key."""
    one_each, several = "3 + 1 GPUs, one process each", "3 + 1 GPUs, 4 agents + 2 trainers"
    pairs = {
        "two": (LONG, "1 + 1 GPUs, 4 agents + 2 trainers", "1 + 1 GPUs, one process each"),
        "four": ("async-4gpu", f"{several}, har, batches of 4 agents", one_each),
        "by_host": ("async-4gpu", several, one_each),
        "channels": ("async-channels", "anymal multi", "anymal uni"),
        "channels_fc": ("async-channels", "franka_cabinet multi", "franka_cabinet uni"),
    }
    return {name: {key: said(ratio(*pair, key)) for key in KEYS} for name, pair in pairs.items()}

"""The figures of the paper's claims, whose text is in `claims.md`.

A row is a claim of the preprint (arXiv:2206.08482), of "GMI-DRL: Empowering Multi-GPU DRL with
Adaptive-Grained Parallelism" (USENIX ATC 2025), or of both, and what was measured here. A cell is
empty where a version claims nothing new.
"""

from __future__ import annotations

from benchmarks.cases import REWARD
from benchmarks.evaluation.async_tables import KEYS, LONG, learners_over_one
from benchmarks.evaluation.evidence import FigureText, Ratio
from benchmarks.evaluation.figures import TRAINING, joined_texts, ratio, text_of, text_of_range
from benchmarks.evaluation.learning_tables import text_of_reward
from benchmarks.evaluation.node_tables import two_nodes_over_one
from benchmarks.evaluation.other_tables import model_fit, text_of_searches
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
from benchmarks.evaluation.writer import Values, word_table


@word_table("claims")
def claims() -> Values:
    """What both versions of the paper claim, and what was measured here."""
    return {
        "busy_one": text_of_range(busy_in_jobs(several=False), ".0%"),
        "busy_several": text_of_range(busy_in_jobs(several=True), ".0%"),
        "model_fit": model_fit(),
        "serving_templates": text_of_range(templates_gains()),
        "com": text_of_range(of_communication()),
        "templates": text_of_range([ratio(*cases) for cases in TEMPLATES.values()]),
        "search": text_of_searches(),
        "served_at_peak": text_of_range([peak_over_peak(task) for task in SERVED]),
        "served_over_one": text_of_range([mps_over_one(task, n) for task in SERVED for n in GMIS]),
        "fixed_total": text_of_range([*fixed_total_ratios().values()]),
        "best_plans": text_of_range([*best_plan_ratios().values()]),
        "mps": {name: text_of(gain) for name, gain in mps_gains().items()},
        "from_512": _more_environments(512, 2048),
        "from_2048": _more_environments(2048, 8192),
        "memory": _more_environments(2048, 8192, "device/peak_memory_mib"),
        "learners": text_of(learners_over_one()),
        "nodes": two_nodes_over_one(),
        "reward": {task: text_of_reward(task) for task in REWARD},
        "humanoid": text_of(our_rate("humanoid, MJX-Warp"), ",.0f"),
        **_reductions(),
        **_asynchronous(),
    }


def _named(name: str, gain: Ratio | None) -> FigureText:
    found = text_of(gain)
    return FigureText(f"{name} {found}", found.evidence)


def _more_environments(few: int, many: int, key: str = TRAINING) -> FigureText:
    """Steps/s, or memory, with many environments in one process over those with few."""
    return text_of_range(
        [
            ratio("tasks-warp", f"{task} warp {many}", f"{task} warp {few}", key)
            for task in ("ant", "humanoid")
        ]
    )


def _reductions() -> dict[str, dict[str, FigureText]]:
    """Of LGR by task, on three layouts."""
    found: dict[str, dict[str, FigureText]] = {"lgr_of_paper": {}, "one_shot": {}, "lgr": {}}
    for task in LGR:
        of_paper = [f"{lgr_gain(task, at):.2f}" for at in LAYOUTS]
        one_shot = (text_of(reduction_gain(task, at, "one_shot")) for at in LAYOUTS)
        chosen = (
            _named(f"`{way}`", reduction_gain(task, at, way))
            for at, way in ((at, algorithm_1(at)) for at in LAYOUTS)
        )
        found["lgr_of_paper"][task] = FigureText(", ".join(of_paper), None)
        found["one_shot"][task] = joined_texts(", ", one_shot)
        found["lgr"][task] = joined_texts(", ", chosen)
    return found


def _asynchronous() -> dict[str, dict[str, FigureText]]:
    """Of A3C with several GMIs over one on each GPU, and of channels, by key."""
    one_each, several = "3 + 1 GPUs, one process each", "3 + 1 GPUs, 4 agents + 2 trainers"
    pairs = {
        "two": (LONG, "1 + 1 GPUs, 4 agents + 2 trainers", "1 + 1 GPUs, one process each"),
        "four": ("async-4gpu", f"{several}, har, batches of 4 agents", one_each),
        "by_host": ("async-4gpu", several, one_each),
        "channels": ("async-channels", "anymal multi", "anymal uni"),
        "channels_fc": ("async-channels", "franka_cabinet multi", "franka_cabinet uni"),
    }
    return {
        name: {key: text_of(ratio(*pair, key)) for key in KEYS} for name, pair in pairs.items()
    }

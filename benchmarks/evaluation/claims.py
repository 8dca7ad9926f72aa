"""The paper's claims, one row each: of the preprint, of ATC 2025, and what was measured here."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.evaluation.async_tables import LONG
from benchmarks.evaluation.figures import (
    NOT_MEASURED,
    WHOLE_RUN,
    bounds,
    ratio,
    results_of,
    shown,
)
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
    gain_of,
)
from benchmarks.evaluation.writer import Rows, table

BACKEND_LINK = "[backends](evaluation/sharing.md#backends)"
ATC_REDUCTION = {
    "ant": "Table 6, mixed over IP: 1.004, 1.007",
    "humanoid": "1.025, 1.024",
    "shadow_hand": "1.002, 1.001",
}
"""Two layouts, in place of the preprint's three."""
FIXED_LINK = "[fixed total](evaluation/one-gpu.md#one-training-run-in-several-gmis)"


@table("claims", "preprint | what it says | preprint's | ATC 2025's | here | section")
def claims() -> Rows:
    """What both versions of the paper claim, and what was measured here.

    A cell is empty where a version says nothing new: the preprint (arXiv:2206.08482), or "GMI-DRL:
    Empowering Multi-GPU DRL with Adaptive-Grained Parallelism" (USENIX ATC 2025).
    """
    return [*_model(), *_overall(), *_studies(), *_asynchronous(), *_of_atc()]


def _model() -> Iterator[list[str]]:
    uses = results_of(USE).get("tasks", {})
    busy = [stage["sm"] for stages in uses.values() for stage in stages.values()]
    yield [
        *("Fig. 1b", "utilisation of a GPU by one process", "below 50 %, mean 32 %"),
        "GMIs add at most 40.8 points",
        f"{bounds(busy, '.0%')} of SMs busy in a stage; of a job: {NOT_MEASURED}",
        "[stages](evaluation/roles.md#what-a-stage-takes-of-a-gpu)",
    ]
    yield ["Table 1", "MPS and MIG as backends", "", "", f"MPS; MIG {NOT_MEASURED}", BACKEND_LINK]
    yield [
        *("Table 2", "cost of MPR, MRR, HAR by bytes", "a formula", ""),
        f"measured over predicted: {model_fit()}",
        "[reduction](evaluation/several-gpus.md#a-mean-alone)",
    ]
    served = results_of(SERVING).get("cases", ())
    gains = [one["colocated"] / one["dedicated"] for one in served if "dedicated" in one]
    yield [
        *("Table 3", "TCG over TDG, serving", "2.5", "", bounds(gains)),
        "[templates](evaluation/roles.md#one-gmi-for-all-tasks-or-one-for-each)",
    ]
    trained = [ratio(f"templates-{task}", *TEMPLATES) for task in ("ant", "humanoid")]
    yield [
        *("Table 4", "TCG_EX over TDG_EX, training", "5", "", bounds(trained)),
        "[templates](evaluation/roles.md#trainers-among-their-simulators-or-apart)",
    ]
    answers = [
        f"{best['gmis_per_gpu']} x {best['num_envs']:,} ({best['impl']})"
        for file in ("search-ant-jax-h200", "search-ant-one_shot-h200")
        if (best := results_of(file).get("best"))
    ]
    yield [
        *("Algorithm 2", "GMIs and environments by profiling", "", "takes several minutes"),
        f"ant: {', '.join(answers) or NOT_MEASURED}; other tasks: {NOT_MEASURED}",
        "[search](evaluation/one-gpu.md#the-search)",
    ]


def _overall() -> Iterator[list[str]]:
    several = [mps_and_share("ant", gmis)[0] for gmis in (2, 4, 8)]
    one = shown(serving_rate(SERVING, "ant 1 x 8192, mps"), ",.0f")
    yield [
        *("Fig. 7a", "serving with GMIs over one process", *["2.62 at most, mean 2.08"] * 2),
        f"no ratio of one call; ant, one GPU: {bounds(several, ',.0f')} steps/s by 2 to 8 GMIs, "
        f"{one} by one; peak against peak, more GPUs: {NOT_MEASURED}",
        BACKEND_LINK,
    ]
    yield [
        *("Fig. 7b", "synchronous training over NCCL", "2.81 at most, mean 1.86"),
        "2.07 at most, mean 1.69",
        f"ant, one GPU, as many environments: {bounds([*fixed_total_ratios().values()])}; "
        f"six tasks, peak against peak: {bounds([*best_plan_ratios().values()])}",
        FIXED_LINK,
    ]
    yield [
        *("Fig. 7c", "the same over Horovod", "2.34 at most, mean 1.75"),
        *("2.34 at most, mean 1.72", NOT_MEASURED, ""),
    ]


def _studies() -> Iterator[list[str]]:
    gains = {task: bounds([mps_over_share(task, n) for n in (2, 4, 8)]) for task in IMPLS}
    yield [
        *("Fig. 8", "MPS and MIG over plain sharing", "both above 1", ""),
        "; ".join(f"{task} {found}" for task, found in gains.items())
        + f" with 2 to 8 GMIs; MIG, three GMIs, BallBalance: {NOT_MEASURED}",
        BACKEND_LINK,
    ]
    for task in LGR:
        ours = [shown(gain_of(task, at, "one_shot").ratio) for at in LAYOUTS]
        own = [
            f"{way} {shown(gain_of(task, at, way).ratio)}"
            for at, way in ((at, algorithm_1(at)) for at in LAYOUTS)
        ]
        yield [
            *("LGR", f"`{task}`, over MPR, three layouts"),
            " ".join(f"{lgr_gain(task, at):.2f}" for at in LAYOUTS),
            ATC_REDUCTION[task],
            f"`one_shot` {' '.join(ours)}; what Algorithm 1 takes: {', '.join(own)}",
            "[LGR](evaluation/several-gpus.md#reduction-of-gradients-in-training)",
        ]
    more = [
        ratio(f"tasks-{impl}", f"{task} {impl} 8192", f"{task} {impl} 2048")
        for task in ("ant", "humanoid")
        for impl in ("jax", "warp")
    ]
    yield [
        *("Fig. 9", "throughput from 512 to 8,192 environments", "grows ever less", ""),
        f"2,048 to 8,192: {bounds(more)} times; 512: {NOT_MEASURED}",
        "[environments](evaluation/one-gpu.md#environments-of-one-gmi)",
    ]
    yield [
        *("Fig. 10", "reward over time, AT, AY, HM, more GPUs", "GMIs ahead", ""),
        f"ant: no faster with GMIs; AY, HM with GMIs: {NOT_MEASURED}",
        "[reward](evaluation/learning.md#reward-over-time)",
    ]


def _asynchronous() -> Iterator[list[str]]:
    two = (LONG, "1 + 1 GPUs, 4 agents + 2 trainers", "1 + 1 GPUs, one process each")
    on_four = "3 + 1 GPUs, 4 agents + 2 trainers"
    four = ("async-4gpu", f"{on_four}, har, batches of 4 agents", "3 + 1 GPUs, one process each")
    by_host = ("async-4gpu", on_four, "3 + 1 GPUs, one process each")
    for key, what, paper in (
        *(("pps", "A3C with GMIs, PPS", "1.88"),),
        *(("ttop", "A3C with GMIs, TTOP", "1.65"),),
    ):
        here = (
            f"{shown(ratio(*two, key))} on two GPUs (100M steps); on four, in runs too short to "
            f"compare, {shown(ratio(*four, key))}, through host memory "
            f"{shown(ratio(*by_host, key))}; by whole runs {shown(ratio(*two, WHOLE_RUN))}, "
            f"{shown(ratio(*four, WHOLE_RUN))}, {shown(ratio(*by_host, WHOLE_RUN))}"
        )
        link = "[A3C](evaluation/roles.md#asynchronous-training)"
        yield ["Fig. 11", f"{what}, mean of 2 and 4 GPUs", paper, paper, here, link]
    names = ("anymal multi", "anymal uni")
    found = [shown(ratio("async-channels", *names, key)) for key in ("pps", "ttop", WHOLE_RUN)]
    yield [
        *("MCC", "channels over UCC, two GPUs: AY", "1.06 PPS, 1.13 TTOP", ""),
        f"{found[0]}, {found[1]}; by whole runs {found[2]}",
        "[channels](evaluation/roles.md#channels)",
    ]
    yield [
        *("MCC", "FC; both on four GPUs", "1.04 to 1.08 PPS, 1.24 to 1.32 TTOP", ""),
        *(NOT_MEASURED, "[channels](evaluation/roles.md#channels)"),
    ]


def _of_atc() -> Iterator[list[str]]:
    nodes = "[several machines](evaluation/several-gpus.md#more-gpus)"
    yield [
        *(
            "",
            "Table 5: one to eight nodes over linear",
            "",
            "0.83; eight nodes: BB 7.16, HM 6.67",
        ),
        *(f"nodes: {NOT_MEASURED}; GPUs of one host: see there", nodes),
    ]
    yield [
        *("", "training with RLlib is slower", "", "62 % at most"),
        *(NOT_MEASURED, "[other libraries](evaluation/speed.md#beside-other-libraries)"),
    ]
    yield [
        *("", "channels: gain that is due to grouping", "", "24 %"),
        *(NOT_MEASURED, "[channels](evaluation/roles.md#channels)"),
    ]

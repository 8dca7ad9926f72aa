"""The tables of synchronous training."""

from __future__ import annotations

from collections.abc import Iterator
from types import MappingProxyType

from benchmarks.cases import PLANS, TASKS
from benchmarks.evaluation.evidence import Ratio
from benchmarks.evaluation.figures import (
    Figure,
    busy_sms,
    measured,
    over,
    rate,
    ratio,
    shown,
    summaries,
)
from benchmarks.evaluation.paper import LGR, lgr_gain
from benchmarks.evaluation.writer import Rows, table
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import select_strategy

LAYOUTS = {"2G2T": "2 GPUs x 2", "2G3T": "2 GPUs x 3", "4G4T": "4 GPUs x 4"}
SCALING = "scaling"


def scaling(gpus: int, gmis: int) -> str:
    """The name of a case of `SCALING`."""
    return f"{gpus} GPUs x {gmis} GMIs x {8192 // gmis}"


WEAK = (
    *((SCALING, gmis, {gpus: scaling(gpus, gmis) for gpus in (1, 2, 4)}) for gmis in (1, 2)),
    ("async-long", 1, {1: "1 GPU, synchronous", 2: "2 GPUs, synchronous"}),
)
"""File, GMIs on each GPU, and its cases by the number of GPUs: ant, 8192 environments on each."""

ONE_GPU = tuple((f"{gmis} GMIs", scaling(1, gmis), scaling(1, 1)) for gmis in (2, 4))
"""What, several GMIs, one process: ant, 8192 environments on a GPU, under MPS."""

OTHERS = (
    ("4 GMIs, no MPS", f"{scaling(1, 4)}, share", scaling(1, 1)),
    *((f"{gpus} GPUs, 2 GMIs on each", scaling(gpus, 2), scaling(gpus, 1)) for gpus in (2, 4)),
)
"""The same without MPS, and on more GPUs against one process on each."""

BACKENDS = ((1, 4), (2, 2))
"""GPUs, and GMIs on each: cases under MPS, and under plain sharing."""

TEMPLATES = MappingProxyType(
    {
        task: (f"templates-{task}", "2 GMIs x 2048, tcg_ex", "2 + 1 GMIs x 2048, tdg_ex")
        for task in ("ant", "humanoid")
    }
)
"""File, and the two cases, by task."""


def pair(file: str, case: str, base: str) -> tuple[Figure | None, Figure | None]:
    """Steps/s of two cases, of one call."""
    return rate(file, case), rate(file, base)


def compared(one: Figure | None, base: Figure | None) -> list[str]:
    """Cells of both and of their ratio."""
    return [*(shown(value, ",.0f") for value in (one, base)), shown(over(one, base))]


def _exchange_of(case: str) -> str:
    """By which strategy the GMIs of a case of `SCALING` exchanged gradients."""
    return f"`{summaries(SCALING, case)[0]['plan']['strategy']}`"


def fixed_total_ratios() -> dict[str, Ratio]:
    """Several GMIs on one GPU over one process with as many environments."""
    return {what: gain for what, *cases in ONE_GPU if (gain := ratio(SCALING, *cases)) is not None}


@table(
    "fixed-total",
    "on each GPU | exchange | GMIs, steps/s: | one process, steps/s: | ratio:",
    SCALING,
)
def fixed_total() -> Rows:
    """The same environments in one process on each GPU, and in several."""
    for what, case, base in (*ONE_GPU, *OTHERS):
        if all(found := pair(SCALING, case, base)):
            yield [what, _exchange_of(case), *compared(*found)]


def fastest(task: str, *, several: bool) -> tuple[Figure, str] | None:
    """Of the plans that were measured with a task, and how fast it is; one process or several."""
    found = [
        (value, f"{gmis} x {num_envs:,}")
        for gmis, num_envs in PLANS
        if (gmis > 1) == several and (value := rate("plans", f"{task} {gmis} x {num_envs}"))
    ]
    return max(found, default=None, key=lambda one: one[0].median)


def best_plan_ratios() -> dict[str, Ratio | None]:
    """Of every task the fastest several GMIs on one GPU over the fastest one process."""
    ratios: dict[str, Ratio | None] = {}
    for task in TASKS:
        one, several = fastest(task, several=False), fastest(task, several=True)
        ratios[task] = over(several[0], one[0]) if one and several else None
    return ratios


@table(
    "best-plans",
    "task | one process x environments, steps/s: | several GMIs, steps/s: | ratio:",
    "plans",
)
def best_plans() -> Rows:
    """Each side at its own peak."""
    for task, gain in best_plan_ratios().items():
        best = [fastest(task, several=several) for several in (False, True)]
        cells = [f"{made[1]}: {made[0].shown()}" if made else shown(None) for made in best]
        yield [f"`{task}`", *cells, shown(gain)]


@table(
    "training-backends",
    "GPUs x GMIs x environments | exchange | `mps`, steps/s: | `share`, steps/s: | ratio:",
    SCALING,
)
def training_backends() -> Rows:
    """MPS against plain sharing, in training of ant."""
    for gpus, gmis in BACKENDS:
        mps = scaling(gpus, gmis)
        if all(found := pair(SCALING, mps, f"{mps}, share")):
            size = f"{gpus} x {gmis} x {8192 // gmis:,}"
            yield [size, _exchange_of(mps), *compared(*found)]


@table(
    "weak-scaling",
    "GPUs x GMIs x environments | steps/s: | over one GPU: | of ideal:",
    more=lambda: measured(file for file, _, cases in WEAK if rate(file, cases[2])),
)
def weak_scaling() -> Rows:
    """8192 environments on every GPU."""
    for file, gmis, cases in WEAK:
        if rate(file, cases[2]) is None:
            continue
        for gpus, name in cases.items():
            if gain := ratio(file, name, cases[1]):
                cells = [shown(rate(file, name), ",.0f"), shown(gain), shown(gain / gpus)]
                yield [f"{gpus} x {gmis} x {8192 // gmis:,}", *cells]


def over_one_gpu() -> Ratio | None:
    """Steps/s of two GPUs with one GMI on each, over those of one GPU."""
    gains = (ratio(file, cases[2], cases[1]) for file, gmis, cases in WEAK if gmis == 1)
    return next((gain for gain in gains if gain), None)


def _jobs_of_one_gpu() -> Iterator[tuple[str, str, str, str]]:
    """Task, GMIs and environments, file, case: of one process first."""
    for gmis in (1, 2, 4):
        yield "ant", f"{gmis} x {8192 // gmis:,}", SCALING, scaling(1, gmis)
    for task in TASKS:
        for gmis, num_envs in PLANS:
            yield task, f"{gmis} x {num_envs:,}", "plans", f"{task} {gmis} x {num_envs}"


def busy_in_jobs(*, several: bool) -> list[Figure]:
    """Part of the SMs that trainings of one GPU keep busy, in one process or in several GMIs."""
    return [
        found
        for _, size, file, case in _jobs_of_one_gpu()
        if size.startswith("1 x") != several and (found := busy_sms(file, case))
    ]


@table(
    "busy-jobs",
    "training | GMIs x environments | steps/s: | SMs busy:",
    more=lambda: measured(file for _, _, file, case in _jobs_of_one_gpu() if busy_sms(file, case)),
)
def busy_jobs() -> Rows:
    """What whole trainings take of a GPU."""
    for task, size, file, case in _jobs_of_one_gpu():
        if busy := busy_sms(file, case):
            yield [f"`{task}`", size, shown(rate(file, case), ",.0f"), shown(busy, ".0%")]


@table(
    "templates",
    "task | `tcg_ex`, steps/s: | `tdg_ex`, steps/s: | ratio: | the paper's:",
    *(file for file, *_ in TEMPLATES.values()),
)
def templates() -> Rows:
    """Trainers among their simulators against trainers apart."""
    for task, cases in TEMPLATES.items():
        yield [f"`{task}`", *compared(*pair(*cases)), "5"]


def algorithm_1(at: str) -> str:
    """The strategy that Algorithm 1 of the paper takes on a layout, which is its LGR."""
    gpus, gmis = at.removesuffix("T").split("G")
    return select_strategy(Layout.even(int(gpus), int(gmis))).strategy


def _with_and_without(at: str, way: str) -> tuple[str, str]:
    """The cases of a reduction on a layout, and of `mpr`."""
    return f"{at} {way}", f"{at} mpr"


def reduction_gain(task: str, at: str, way: str) -> Ratio | None:
    """Steps/s of the one over those of the other."""
    return ratio(f"lgr-{task}", *_with_and_without(at, way))


@table(
    "lgr",
    "task | GMIs | exchange | by Algorithm 1 | `mpr`, steps/s: | steps/s: | ratio: | "
    "the paper's LGR:",
    *(f"lgr-{task}" for task in LGR),
)
def lgr() -> Rows:
    """Every reduction that was measured in training against `mpr`."""
    for task in LGR:
        for way in ("one_shot", "mrr", "har"):
            for at in LAYOUTS:
                chosen = way == algorithm_1(at)
                found = pair(f"lgr-{task}", *_with_and_without(at, way))
                if not chosen and found[0] is None:
                    continue
                paper = f"{lgr_gain(task, at):.2f}" if chosen else "-"
                own, mpr, gain = compared(*found)
                names = [f"`{task}`", LAYOUTS[at], f"`{way}`", "yes" if chosen else "no"]
                yield [*names, mpr, own, gain, paper]


@table(
    "num-env",
    "task | environments: | steps/s: | memory, MiB:",
    "tasks-warp",
)
def num_env() -> Rows:
    """Throughput and memory over environments, one GMI."""
    for task in ("ant", "humanoid"):
        for envs in (512, 2048, 8192, 32768):
            name = f"{task} warp {envs}"
            found = rate("tasks-warp", name), rate("tasks-warp", name, "device/peak_memory_mib")
            if all(found):
                yield [f"`{task}`", f"{envs:,}", *(shown(one, ",.0f") for one in found)]

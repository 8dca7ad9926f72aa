"""The tables of synchronous training."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import NamedTuple

from benchmarks.cases import PLANS, TASKS
from benchmarks.evaluation.figures import (
    Figure,
    call_of,
    figure,
    markdown,
    rate,
    ratio,
    results_of,
    shown,
    source,
    summaries,
)
from benchmarks.evaluation.paper import LGR, lgr_gain
from gmijax.partition.layout import Layout
from gmijax.partition.reduction import select_strategy

LAYOUTS = {"2G2T": "2 GPUs x 2", "2G3T": "2 GPUs x 3", "4G4T": "4 GPUs x 4"}
TWO_TREES = "exchange-in-program-h200"
ONE_GPU = (
    *(
        ("4 GMIs, MJX-JAX", file, "4 GMIs x 2048, mps", "1 GMI x 8192")
        for file in ("ant-1gpu-one_shot", "ant-1gpu")
    ),
    *(
        ("2 GMIs, MJX-Warp", file, "1 GPUs x 2 GMIs x 4096", "1 GPUs x 1 GMIs x 8192")
        for file in ("scaling-one_shot", "scaling")
    ),
    ("2 GMIs, MJX-Warp", TWO_TREES, "2x4096", "1x8192"),
    ("4 GMIs, MJX-Warp", TWO_TREES, "4x2048", "1x8192"),
)
"""What, file, several GMIs, one process: ant, 8192 environments on a GPU, under MPS."""

OTHERS = (
    ("4 GMIs, MJX-JAX, no MPS", "ant-1gpu", "4 GMIs x 2048, share", "1 GMI x 8192"),
    ("2 GPUs, 2 GMIs on each, MJX-Warp", TWO_TREES, "2gpu-2x4096", "2gpu-1x8192"),
    *(
        (
            *(f"{gpus} GPUs, 2 GMIs on each, MJX-Warp", "scaling"),
            *(f"{gpus} GPUs x 2 GMIs x 4096", f"{gpus} GPUs x 1 GMIs x 8192"),
        )
        for gpus in (2, 4)
    ),
)
"""The same without MPS, and on more GPUs against one process on each."""

IN_GPU_MEMORY = ("one_shot", "auto")
"""Exchanges that do not pass the host: `auto` where a file does not say what it became."""


def pair(file: str, case: str, base: str) -> tuple[Figure | None, Figure | None]:
    """Steps/s of two cases, of one call."""
    if file != TWO_TREES:
        return rate(file, case), rate(file, base)
    # Two trees in each of its own calls; the old one has all cases.
    for one in results_of(file).get("calls", ()):
        if {case, base} <= one["cases"].keys():
            several, alone = (
                figure([run["steps_per_s"] for run in one["cases"][name]["base"]])
                for name in (case, base)
            )
            return several, alone
    return None, None


def exchange_of(file: str, case: str) -> str:
    """By which strategy the GMIs of a case exchanged gradients."""
    found = summaries(file, case)
    return found[0]["plan"]["strategy"] if found else "auto"


def fixed_total_ratios() -> dict[str, float | None]:
    """Several GMIs on one GPU over one process with as many environments, as jobs exchange now."""
    ratios = {}
    for what, file, case, base in ONE_GPU:
        if exchange_of(file, case) in IN_GPU_MEMORY:
            several, alone = pair(file, case, base)
            ratios[f"{what} ({file})"] = (
                several.median / alone.median if several and alone else None
            )
    return ratios


def fixed_total() -> list[str]:
    """The same environments in one process on each GPU, and in several."""
    rows = []
    for what, file, case, base in (*ONE_GPU, *OTHERS):
        several, alone = pair(file, case, base)
        gain = several.median / alone.median if several and alone else None
        rates = (shown(value, ",.0f") for value in (several, alone))
        rows.append([what, f"`{exchange_of(file, case)}`", *rates, shown(gain), f"`{file}`"])
    head = "on each GPU | exchange | GMIs, steps/s: | one process, steps/s: | ratio: | file"
    files = dict.fromkeys(file for _, file, *_ in (*ONE_GPU, *OTHERS))
    return [*markdown(head, rows), *source(*files)]


def fastest(task: str, *, several: bool) -> tuple[Figure, str] | None:
    """Of the plans that were measured with a task, and how fast it is; one process or several."""
    found = [
        (value, f"{gmis} x {num_envs:,}")
        for gmis, num_envs in PLANS
        if (gmis > 1) == several and (value := rate("plans", f"{task} {gmis} x {num_envs}"))
    ]
    return max(found, default=None, key=lambda one: one[0].median)


def best_plan_ratios() -> dict[str, float | None]:
    """Of every task the fastest several GMIs on one GPU over the fastest one process."""
    ratios = {}
    for task in TASKS:
        one, several = fastest(task, several=False), fastest(task, several=True)
        ratios[task] = several[0].median / one[0].median if one and several else None
    return ratios


def best_plans() -> list[str]:
    """Each side at its own peak."""
    rows = []
    for task, gain in best_plan_ratios().items():
        best = [fastest(task, several=several) for several in (False, True)]
        cells = [f"{made[1]}: {made[0].shown()}" if made else shown(None) for made in best]
        rows.append([f"`{task}`", *cells, shown(gain)])
    head = "task | one process x environments, steps/s: | several GMIs, steps/s: | ratio:"
    return [*markdown(head, rows), *source("plans")]


def training_backends() -> list[str]:
    """MPS against plain sharing, in training."""
    rows = []
    for file, what in (("ant-1gpu", "4 GMIs x 2048"), ("ant-2gpu", "2 GPUs x 2 GMIs x 2048")):
        names = [f"{what}, {backend}" for backend in ("mps", "share")]
        rates = (shown(rate(file, name), ",.0f") for name in names)
        exchange = f"`{exchange_of(file, names[0])}`"
        rows.append([what, exchange, *rates, shown(ratio(file, names[0], names[1]))])
    head = "ant, MJX-JAX | exchange | `mps`, steps/s: | `share`, steps/s: | ratio:"
    return [*markdown(head, rows), *source("ant-1gpu", "ant-2gpu")]


def weak_scaling() -> list[str]:
    """8192 environments on every GPU."""
    rows = []
    for file, gmis, way in (
        *(("scaling", 1, "`flat`"), ("scaling-one_shot", 2, "`one_shot`")),
        ("scaling", 2, "`har`"),
    ):
        names = [f"{gpus} GPUs x {gmis} GMIs x {8192 // gmis}" for gpus in (1, 2, 4, 8)]
        for gpus, name in zip((1, 2, 4, 8), names, strict=True):
            gain = ratio(file, name, names[0])
            cells = [shown(rate(file, name), ",.0f"), shown(gain), shown(gain and gain / gpus)]
            rows.append([f"{gpus} x {gmis} x {8192 // gmis:,}", way, *cells])
    head = "GPUs x GMIs x environments | exchange | steps/s: | over one GPU: | of ideal:"
    return [*markdown(head, rows), *source("scaling", "scaling-one_shot")]


def over_one_gpu(gpus: int) -> float | None:
    """Steps/s of several GPUs with one GMI on each, over those of one GPU."""
    return ratio("scaling", f"{gpus} GPUs x 1 GMIs x 8192", "1 GPUs x 1 GMIs x 8192")


def templates() -> list[str]:
    """Trainers among their simulators against trainers apart."""
    rows = []
    for task in ("ant", "humanoid"):
        both = ("2 GMIs x 2048, tcg_ex", "2 + 1 GMIs x 2048, tdg_ex")
        rates = [shown(rate(f"templates-{task}", name), ",.0f") for name in both]
        rows.append([f"`{task}`", *rates, shown(ratio(f"templates-{task}", *both)), "5"])
    head = "task | `tcg_ex`, steps/s: | `tdg_ex`, steps/s: | ratio: | the paper's:"
    return [*markdown(head, rows), *source("templates-ant", "templates-humanoid")]


class Gain(NamedTuple):
    """A reduction in training beside `mpr`; None: not measured.

    Attributes:
      mpr, own: environment steps per second.
      ratio: of one call, or of two calls with the same commands.
    """

    mpr: Figure | None
    own: Figure | None
    ratio: float | None


def algorithm_1(at: str) -> str:
    """The strategy that Algorithm 1 of the paper takes on a layout, which is its LGR."""
    gpus, gmis = at.removesuffix("T").split("G")
    return select_strategy(Layout.even(int(gpus), int(gmis))).strategy


def gain_of(task: str, at: str, way: str) -> Gain:
    """A reduction on a layout against `mpr`: of the same call where that has both."""
    file = f"lgr-{task}-one_shot" if way == "one_shot" else f"lgr-{task}"
    # Runs of rings that were made by themselves.
    alone = f"lgr-{task}-{way}"
    mpr = rate(file, f"{at} mpr")
    own = rate(file, f"{at} {way}") or rate(alone, f"{at} {way}")
    return Gain(mpr, own, own.median / mpr.median if own and mpr else None)


def lgr() -> list[str]:
    """Every reduction that was measured in training against `mpr`."""
    rows, files = [], []
    for task in LGR:
        files += [f"lgr-{task}-one_shot", f"lgr-{task}", f"lgr-{task}-mrr"]
        for way in ("one_shot", "mrr", "har"):
            for at in LAYOUTS:
                chosen, gain = way == algorithm_1(at), gain_of(task, at, way)
                if not chosen and gain.own is None:
                    continue
                paper = f"{lgr_gain(task, at):.2f}" if chosen else "-"
                cells = [shown(gain.mpr, ",.0f"), shown(gain.own, ",.0f"), shown(gain.ratio)]
                names = [f"`{task}`", LAYOUTS[at], f"`{way}`", "yes" if chosen else "no"]
                rows.append([*names, *cells, paper])
    head = (
        "task | GMIs | exchange | by Algorithm 1 | `mpr`, steps/s: | steps/s: | ratio: | "
        "the paper's LGR:"
    )
    return [*markdown(head, rows), *source(*filter(call_of, files))]


def num_env() -> list[str]:
    """Throughput and memory over environments, one GMI."""
    rows = []
    for task in ("ant", "humanoid"):
        for impl in ("jax", "warp"):
            for envs in (512, 2048, 8192, 32768):
                name, file = f"{task} {impl} {envs}", f"tasks-{impl}"
                cells = [shown(rate(file, name), ",.0f"), _memory(file, name)]
                rows.append([f"`{task}`", f"{envs:,}", impl, *cells])
    return [
        *markdown("task | environments: | MJX | steps/s: | memory, MiB:", rows),
        *source("tasks-jax", "tasks-warp"),
    ]


def _memory(file: str, name: str) -> str:
    found = [summary["device"]["peak_memory_mib"] for summary in summaries(file, name)]
    return shown(figure(found), ",.0f")


SMALL = "search-ant-one_shot-h200"


def small_gmis() -> dict[int, float]:
    """Steps/s of a GPU by the number of GMIs with 2,048 environments each, MJX-Warp."""
    return {
        point["gmis_per_gpu"]: point["projected"]
        for point in results_of(SMALL).get("points", ())
        if (point["impl"], point["num_envs"]) == ("warp", 2048)
    }


def many_small() -> list[str]:
    """What a GPU makes of several small processes."""
    rates = small_gmis()
    rows = [
        [f"{gmis} x 2,048", f"{value:,.0f}", shown(value / rates[1] if 1 in rates else None)]
        for gmis, value in sorted(rates.items())
    ]
    head = "GMIs x environments each, ant, MJX-Warp | steps/s of the GPU: | over one:"
    return [*markdown(head, rows), *source(SMALL)]


TRAINING_TABLES: MappingProxyType[str, Callable[[], list[str]]] = MappingProxyType(
    {
        "fixed-total": fixed_total,
        "best-plans": best_plans,
        "training-backends": training_backends,
        "weak-scaling": weak_scaling,
        "templates": templates,
        "lgr": lgr,
        "num-env": num_env,
        "many-small": many_small,
    }
)
"""By the name that documents use: `<!-- table: NAME -->`."""

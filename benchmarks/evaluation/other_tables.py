"""The tables beside training: serving, searches, what tasks learn, speed, reductions, faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from benchmarks import node_scaling as scaling
from benchmarks.cases import TASKS
from benchmarks.evaluation.figures import (
    NOT_MEASURED,
    Figure,
    bounds,
    figure,
    markdown,
    rate,
    results_of,
    shown,
    source,
)
from benchmarks.paper_model import Task, serving_gain
from benchmarks.records import RESULTS, read_calls

SERVING, OLD_BACKENDS = "serving-nvidia-h200", "serving-backends-nvidia-h200"
USE, REDUCTION = "resource-use-nvidia-h200", "reduction-nvidia-h200"
IMPLS = {"ant": "jax", "humanoid": "warp"}
"""Which MJX each task was served with."""

RATES = ("step_per_s_sim", "step_per_s_inference", "step_per_s_train")


def serving_rate(file: str, name: str, impl: str | None = None) -> float | None:
    """Steps/s of a serving case; several implementations may have one name in an old file."""
    for case in results_of(file).get("cases", ()):
        if case["name"] == name and impl in (None, case.get("impl", impl)):
            return case["colocated"]
    return None


def backends_file() -> str:
    """Which file has serving under both backends."""
    cases = results_of(SERVING).get("cases", ())
    return SERVING if any(case["backend"] == "share" for case in cases) else OLD_BACKENDS


def mps_and_share(task: str, gmis: int) -> tuple[float | None, float | None]:
    """Steps/s of serving with 8192 environments in all, under both backends."""
    name, file = f"{task} {gmis} x {8192 // gmis}", backends_file()
    mps, share = (
        serving_rate(file, f"{name}, {backend}", IMPLS[task]) for backend in ("mps", "share")
    )
    return mps, share


def mps_over_share(task: str, gmis: int) -> float | None:
    """The ratio of the two."""
    mps, share = mps_and_share(task, gmis)
    return mps / share if mps and share else None


def backends() -> list[str]:
    """MPS against plain sharing."""
    rows = [
        [
            *(f"`{task}`", f"{gmis} x {8192 // gmis:,}"),
            *(shown(value, ",.0f") for value in mps_and_share(task, gmis)),
            *(shown(mps_over_share(task, gmis)), NOT_MEASURED),
        ]
        for task in IMPLS
        for gmis in (2, 3, 4, 8)
    ]
    head = "task | GMIs x environments | `mps`, steps/s: | `share`, steps/s: | ratio: | MIG:"
    return [*markdown(head, rows), *source(backends_file())]


def serving_templates() -> list[str]:
    """Simulator and agent in one GMI against apart, with the paper's model."""
    calls = reversed(read_calls(RESULTS / f"{SERVING}.json"))
    timed = ([case for case in call.results["cases"] if "simulator_s" in case] for call in calls)
    rows = []
    for case in next(cases for cases in timed if cases):
        gain = case["colocated"] / case["dedicated"]
        rates = (f"{case[key]:,.0f}" for key in ("colocated", "dedicated"))
        times = (f"{1e3 * case[key]:.2f}" for key in ("simulator_s", "agent_s", "com_s"))
        rows.append([case["name"], *rates, *times, f"{predicted_gain(case):.2f}", f"{gain:.2f}"])
    head = (
        "GMIs that simulate | `tcg`, steps/s: | `tdg`, steps/s: | T_s, ms: | T_a, ms: | COM, ms: "
        "| model: | measured:"
    )
    return [*markdown(head, rows), *source(SERVING)]


def predicted_gain(case: Mapping[str, Any]) -> float:
    """Throughput of co-located over dedicated GMIs by equation 2, with the paper's R and alpha."""
    simulator, agent = Task(case["simulator_s"], 10.0), Task(case["agent_s"], 1.0)
    return serving_gain(simulator, agent, 0.2, case["com_s"])


def resource_use() -> list[str]:
    """What the tasks of an iteration take of a GPU."""
    rows = []
    for task, uses in results_of(USE).get("tasks", {}).items():
        for stage in ("simulator", "agent", "trainer"):
            use = uses[stage]
            cells = [f"{1e3 * use['seconds']:.2f}", f"{use['sm']:.0%}", f"{use['memory']:.2%}"]
            rows.append([f"`{task}`", stage, *cells])
    head = "task | stage | time in an iteration, ms: | SMs busy: | memory:"
    return [*markdown(head, rows), *source(USE)]


def search() -> list[str]:
    """Points of the searches: GMIs and environments of each."""
    files = {"search-ant-jax-h200": "jax", "search-ant-one_shot-h200": "warp"}
    files |= {"search-ant-warp-7-and-1-h200": "warp", "search-ant-warp-1-h200": "warp"}
    rows = []
    for file, impl in files.items():
        results = results_of(file)
        for p in results.get("points", ()):
            if p["impl"] == impl and p.get("projected"):
                best = "**answer**" if _is_answer(p, results["best"]) else ""
                size = f"{p['gmis_per_gpu']} x {p['num_envs']:,}"
                rows.append([f"`{file}`", impl, size, f"{p['projected']:,.0f}", best])
    head = "search | MJX | GMIs x environments | steps/s of the GPU: |"
    return [*markdown(head, rows), *source(*files)]


def _is_answer(point: dict[str, Any], best: dict[str, Any]) -> bool:
    return all(point[key] == best[key] for key in ("gmis_per_gpu", "num_envs", "impl"))


def reduction() -> list[str]:
    """A mean of 1.5 million numbers, alone and in a chain."""
    rows = []
    for row in results_of(REDUCTION).get("rows", ()):
        if row["num_floats"] == 1_500_000:
            times = [
                f"{1e3 * row[key]:.3f}" for key in ("median_s", "p10_s", "p90_s", "chained_s")
            ]
            fit = row["median_s"] / row["predicted_s"] if row["predicted_s"] else None
            layout = read_layout(row["layout"])
            spread = " to ".join(times[1:3])
            rows.append([layout, f"`{row['name']}`", times[0], spread, times[3], shown(fit)])
    head = "GPUs x GMIs | exchange | alone, ms: | 10 to 90 %: | in a chain, ms: | over the model:"
    return [*markdown(head, rows), *source(REDUCTION)]


def read_layout(text: str) -> str:
    """`2 x 3` of `[[0,1,2],[3,4,5]]`."""
    gpus = text.split("],[")
    return f"{len(gpus)} x {gpus[0].count(',') + 1}"


def model_fit() -> str:
    """Measured over predicted time of all reductions of the paper's strategies."""
    rows = results_of(REDUCTION).get("rows", ())
    fits = [row["median_s"] / row["predicted_s"] for row in rows if row["predicted_s"]]
    return bounds(fits, ".3g")


def node_scaling() -> list[str]:
    """What the cost model predicts for several nodes, and how far off it was on one."""
    fits = [f"{bounds(scaling.model_fit(way), '.2g')} (`{way}`)" for way in scaling.PATHS]
    fit = (
        f"Measured over predicted time of a mean on one node, one GMI on each GPU: "
        f"{' and '.join(fits)}; all strategies and layouts: {model_fit()}."
    )
    return [*scaling.table(), "", fit, *source(scaling.BANDWIDTHS, scaling.RATES)]


def learning() -> list[str]:
    """What every task reached over its seeds, and how long that took alone on a GPU."""
    rows = []
    for file, name, case in _learnt():
        runs = [run for run in case["runs"] if "summary" in run]
        steps = bounds([run["summary"]["env_steps"] / 1e6 for run in runs], ".0f")
        alone = [run["summary"]["train_wall_s"] for run in runs if "together" not in run]
        returns = ", ".join(shown(run["summary"]["final_return"], ",.0f") for run in runs)
        metrics = ", ".join(_metrics(runs))
        impl = runs[0]["summary"].get("impl", "")
        rows.append([name, impl, steps, shown(figure(alone), ".0f"), returns, metrics])
        rows[-1].append(f"`{file}`")
    head = (
        "case | MJX | million steps: | seconds alone on a GPU: | return of every run "
        "| metrics, least to most | file"
    )
    files = dict.fromkeys(file for file, *_ in _learnt())
    return [*markdown(head, rows), *source(*files)]


_MARKS = (
    ("ant", 3000, "20 s", "async-long", "1 GPU, synchronous"),
    ("humanoid", 5000, "under 240 s", "learn-humanoid", "humanoid"),
)
"""Task, return, what Isaac Gym publishes for it on an A100 (arXiv:2108.10470); file and case."""


def marks() -> list[str]:
    """Seconds from the first report of a run alone on its GPU to a return that others publish."""
    rows = []
    for task, mark, published, file, case in _MARKS:
        found = _times_to(mark, file, case)
        reached = [seconds for seconds in found if seconds is not None]
        share = f"{len(reached)} of {len(found)}"
        rows.append([task, f"{mark:,}", share, shown(figure(reached), ".1f"), published])
    head = "task | return: | runs that reached it: | seconds, here: | Isaac Gym, on an A100:"
    return [*markdown(head, rows), *source(*(file for *_, file, _ in _MARKS))]


def seconds_to_mark(task: str) -> Figure | None:
    """Seconds of training until a task reaches the return that Isaac Gym's authors give."""
    for name, mark, _, file, case in _MARKS:
        if name == task:
            return figure([s for s in _times_to(mark, file, case) if s is not None])
    return None


def _times_to(mark: float, file: str, case: str) -> list[float | None]:
    """Of every run that was alone on its GPU; None of one that did not get there."""
    runs = results_of(file).get("cases", {}).get(case, {}).get("runs", ())
    alone = [run["curve"] for run in runs if "curve" in run and "together" not in run]
    return [_seconds_to(mark, curve) for curve in alone]


def _seconds_to(mark: float, curve: list[tuple[int, float, float | None]]) -> float | None:
    """Of a curve [steps, seconds, return]."""
    started_s = curve[0][1]
    return next((s - started_s for _, s, found in curve if (found or 0.0) >= mark), None)


def _learnt() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path in sorted([*RESULTS.glob("learn-*.json"), *RESULTS.glob("entropy-franka_c*.json")]):
        for name, case in results_of(path.stem)["cases"].items():
            if any("summary" in run for run in case["runs"]):
                yield path.stem, name, case


def _metrics(runs: list[dict[str, Any]]) -> Iterator[str]:
    for name in runs[0].get("metrics", ()):
        values = [run["metrics"][name] for run in runs]
        yield f"{name.removeprefix('metric/')} {bounds(values, '.3g')}"


def throughput() -> list[str]:
    """Steps/s and memory of every task, size and implementation."""
    rows = []
    for task in TASKS:
        for envs in (2048, 8192, 32768):
            for impl in ("jax", "warp"):
                file, name = f"tasks-{impl}", f"{task} {impl} {envs}"
                cells = [shown(rate(file, name, key), ",.0f") for key in RATES]
                rows.append([f"`{task}`", f"{envs:,}", impl, *cells])
    head = "task | environments: | MJX | simulation: | with inference: | with training:"
    return [*markdown(head, rows), *source("tasks-jax", "tasks-warp")]


def faults() -> list[str]:
    """Seconds from a fault until all GMIs train again."""
    rows = [[kind, shown(found, ".0f")] for kind, found in seconds_to_recover().items()]
    return [*markdown("fault | seconds until all GMIs train again:", rows), *source("faults-h200")]


def seconds_to_recover() -> dict[str, Figure | None]:
    """By kind of fault."""
    kinds: dict[str, list[float]] = {}
    for row in results_of("faults-h200").get("rows", ()):
        kinds.setdefault(row["fault"], []).append(row["seconds"])
    return {kind: figure(seconds) for kind, seconds in kinds.items()}


def faults_on_a_cpu() -> list[str]:
    """Faults of every command, and how many came to something else than they must."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in _rows_of_faults():
        groups.setdefault(row["group"], []).append(row)
    rows = []
    for group, found in sorted(groups.items()):
        trials = {row["trial"]: row for row in found}.values()  # One may have several faults.
        unexpected = sum(row["outcome"] != "as wanted" for row in found)
        sums = (sum(len(row[what]) for row in trials) for what in ("lost", "leaked"))
        seconds = shown(figure([row["seconds"] for row in found]), ".0f")
        kinds = len({row["kind"] for row in found})
        rows.append([group, *map(str, (kinds, len(found), unexpected, *sums)), seconds])
    head = "faults of | kinds: | faults: | unexpected: | lost: | leaked: | seconds a fault:"
    return [*markdown(head, rows), *source("faults-cpu")]


def _rows_of_faults() -> Iterator[Mapping[str, Any]]:
    """Of all calls of the newest commit, each with seeds of its own."""
    path = RESULTS / "faults-cpu.json"
    calls = read_calls(path) if path.exists() else []
    for call in (one for one in calls if one.commit == calls[-1].commit):
        for row in call.results.get("rows", ()):
            yield {**row, "trial": (call.date, row["trial"])}


def sm_shares() -> list[str]:
    """At which caps on SMs half-precision products were right."""
    rows = []
    for row in results_of("sm-shares-nvidia-h200").get("rows", ()):
        wrong = {p["library"] for p in row["products"] if p["wrong"]}
        verdict = f"**wrong** ({', '.join(sorted(wrong))})" if wrong else "right"
        rates = [f"{value:.0f}" for value in row["tflops"].values()]
        rows.append([f"{row['sm_percent']:g}", str(row["num_sms"]), verdict, *rates])
    head = "cap, %: | SMs: | products | TFLOP/s bfloat16: | TFLOP/s TF32:"
    return [*markdown(head, rows), *source("sm-shares-nvidia-h200")]


def stencil() -> list[str]:
    """Four GMIs that share a grid against one process."""
    rows = []
    for run in results_of("stencil-nvidia-h200").get("runs", ()):
        slower = run["us_per_step"] / run["one_us_per_step"]
        times = (f"{run[key]:.0f}" for key in ("us_per_step", "one_us_per_step"))
        rows.append([run["size"], f"`{run['backend']}`", *times, f"{slower:.2f}"])
    head = "grid | backend | four GMIs, us a step: | one process, us: | times slower:"
    return [*markdown(head, rows), *source("stencil-nvidia-h200")]


OTHER_TABLES: MappingProxyType[str, Callable[[], list[str]]] = MappingProxyType(
    {
        "backends": backends,
        "serving-templates": serving_templates,
        "resource-use": resource_use,
        "search": search,
        "reduction": reduction,
        "node-scaling": node_scaling,
        "learning": learning,
        "marks": marks,
        "throughput": throughput,
        "faults": faults,
        "faults-cpu": faults_on_a_cpu,
        "sm-shares": sm_shares,
        "stencil": stencil,
    }
)
"""By the name that documents use: `<!-- table: NAME -->`."""

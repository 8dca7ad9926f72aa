"""Prints Markdown tables of results: `python -m benchmarks.tables throughput|learning|lgr`.

They are made from the JSON files in `benchmarks/results`, and pasted into the documents.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from typing import Any

from benchmarks.cases import TASKS
from benchmarks.run import RATES, RESULTS, median

PAPER_LGR = {
    "ant": {"2G2T": (107_689, 114_734), "2G3T": (138_369, 164_655), "4G4T": (168_619, 207_834)},
    "humanoid": {
        **{"2G2T": (163_723, 168_300), "2G3T": (179_273, 190_919)},
        "4G4T": (308_873, 336_591),
    },
    "shadow_hand": {
        **{"2G2T": (78_270, 88_149), "2G3T": (79_545, 93_785)},
        "4G4T": (133_044, 166_722),
    },
}
"""Environment steps per second with MPR and with LGR (arXiv:2206.08482, "LGR vs MPR")."""


def main(which: str) -> int:
    """Prints the table `which`; returns the exit code."""
    tables = {"throughput": throughput, "learning": learning, "lgr": lgr}
    if which not in tables:
        sys.stderr.write(f"table {which}: allowed are {', '.join(tables)}\n")
        return 2
    sys.stdout.write("\n".join(tables[which]()) + "\n")
    return 0


def throughput() -> Iterator[str]:
    """Environment steps per second of every task, size and implementation, with memory."""
    cases = {**load("tasks-jax"), **load("tasks-warp")}
    yield "| task | environments | MJX | simulation | with inference | with training | MiB |"
    yield "|---|---|---|---|---|---|---|"
    for task in TASKS:
        for num_envs in (2048, 8192, 32768):
            for impl in ("jax", "warp"):
                case = cases.get(f"{task} {impl} {num_envs}")
                if case is None or not case["runs"]:
                    continue
                summaries = [run["summary"] for run in case["runs"] if "summary" in run]
                if not summaries:
                    shown = ["failed"] * 4
                else:
                    memory = median([s["device"] for s in summaries], "peak_memory_mib")
                    rates = [f"{median(summaries, rate):,.0f}" for rate in RATES]
                    shown = [*rates, f"{memory:,.0f}"]
                yield f"| `{task}` | {num_envs:,} | {impl} | {' | '.join(shown)} |"


def learning() -> Iterator[str]:
    """What every task reached over its seeds, and how long that took alone on a GPU."""
    yield "| task | million steps | seconds | return of every seed | metrics, means over seeds |"
    yield "|---|---|---|---|---|"
    for task in TASKS:
        case = load(f"learn-{task}").get(task)
        runs = [run for run in case["runs"] if "summary" in run] if case else []
        if not runs:
            continue
        steps = runs[0]["summary"]["env_steps"] / 1e6
        alone = [run["summary"] for run in runs if "together" not in run]
        seconds = median(alone, "train_wall_s") if alone else math.nan
        returns = ", ".join(f"{run['summary']['final_return']:,.1f}" for run in runs)
        means = {
            name.removeprefix("metric/"): sum(run["metrics"][name] for run in runs) / len(runs)
            for name in runs[0]["metrics"]
        }
        metrics = ", ".join(f"{name} {mean:.3g}" for name, mean in means.items())
        yield f"| `{task}` | {steps:,.0f} | {seconds:,.0f} | {returns} | {metrics} |"


def lgr() -> Iterator[str]:
    """Environment steps per second with MPR and with the best other reduction."""
    yield "| task | layout | `mpr` | best other | ratio | the paper's |"
    yield "|---|---|---|---|---|---|"
    for task, layouts in PAPER_LGR.items():
        papers = {layout: f"{best / base:.2f}" for layout, (base, best) in layouts.items()}
        yield from _lgr_rows(task, {**load(f"lgr-{task}"), **load(f"lgr-{task}-mrr")}, papers)
        # A row of its own: ratios are taken within a suite.
        yield from _lgr_rows(task, load(f"lgr-{task}-one_shot"), papers)
    for name in ("ant", "ant-1.5M"):
        yield from _lgr_rows(f"{name}, MJX-JAX", load(f"lgr-{name}-jax"), {})


def _lgr_rows(name: str, cases: dict[str, Any], papers: dict[str, str]) -> Iterator[str]:
    for layout in ("2G2T", "2G3T", "4G4T"):
        rates = {
            case_name.removeprefix(f"{layout} "): median(summaries, "step_per_s_train")
            for case_name, case in cases.items()
            if case_name.startswith(layout)
            and (summaries := [run["summary"] for run in case["runs"] if "summary" in run])
        }
        mpr = rates.pop("mpr", None)
        if mpr and rates:
            way = max(rates, key=rates.__getitem__)
            yield (
                f"| `{name}` | {layout} | {mpr:,.0f} | {rates[way]:,.0f} (`{way}`) | "
                f"{rates[way] / mpr:.2f} | {papers.get(layout, '')} |"
            )


def load(suite: str) -> dict[str, Any]:
    """The cases of a suite by name; none if it has not been run."""
    path = RESULTS / f"{suite}.json"
    return json.loads(path.read_text())["cases"] if path.exists() else {}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else ""))

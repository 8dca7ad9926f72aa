"""Measures the mean of gradients: `python -m benchmarks.reduction`, without training anything.

Every strategy runs on every layout that it takes, with buffers of three sizes, in real GMIs of
the backend that this machine has. Two large probes give the bandwidths of the cost model, whose
prediction stands beside each measurement. Writes `benchmarks/results/reduction-<device>.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.run import RESULTS
from gmijax.collectives.cost_model import BYTES_PER_FLOAT, COSTS, predicted_s
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import ConfigError
from gmijax.launcher import Launch, run_gmis
from gmijax.partition.layout import Layout
from gmijax.partition.machine import detect_machine
from gmijax.partition.planner import make_plan
from gmijax.partition.reduction import select_strategy, why_not_strategy
from gmijax.partition.supervisor import Patience
from gmijax.rundir import RunPaths, read_json, write_json

SIZES = (110_000, 290_000, 1_500_000)
PROBE_FLOATS = 6_000_000
PROBES = {"b1": ("mpr", Layout(((0, 1),))), "b2": ("flat", Layout(((0,), (1,))))}
"""With two members every strategy moves M_p bytes, so bandwidth is M_p over time."""

LAYOUTS = ("[[0,1]]", "[[0],[1]]", "[[0,1],[2,3]]")
PATIENCE = Patience(start_timeout_s=300, stall_timeout_s=120, stop_timeout_s=60, grace_s=5)


def main() -> int:
    """Measures what the command line asks for; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--layouts", nargs="+", default=LAYOUTS, metavar="[[0,1],[2,3]]")
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES, metavar="FLOATS")
    parser.add_argument("--calls", type=int, default=200, help="calls to take the median of")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    layouts = [Layout(tuple(map(tuple, json.loads(text)))) for text in arguments.layouts]
    calls = arguments.calls
    probes = {name: measure(*probe, PROBE_FLOATS, calls // 4) for name, probe in PROBES.items()}
    bandwidths = {
        name: PROBE_FLOATS * BYTES_PER_FLOAT / found["median_s"] for name, found in probes.items()
    }
    sys.stdout.write(", ".join(f"{k} {v / 1e9:.2f} GB/s" for k, v in bandwidths.items()) + "\n")
    rows = []
    for row in measure_all(layouts, arguments.sizes, calls, bandwidths):
        rows.append(row)
        sys.stdout.write(line(row) + "\n")
    device = probes["b1"]["device"]
    results = {"device": device, "cores": os.cpu_count(), "probe_floats": PROBE_FLOATS}
    results |= {"bytes_per_s": bandwidths, "rows": rows}
    path = arguments.out / f"reduction-{device.replace(' ', '-').lower()}.json"
    arguments.out.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1) + "\n")
    sys.stdout.write(f"written: {path}\n")
    return 0


def measure_all(
    layouts: list[Layout], sizes: list[int], calls: int, bandwidths: dict[str, float]
) -> Iterator[dict[str, Any]]:
    """One row for each layout, size and strategy."""
    for layout in layouts:
        chosen = select_strategy(layout).strategy
        for num_floats in sizes:
            for strategy in COSTS:
                if why_not_strategy(strategy, layout):
                    continue
                found = measure(strategy, layout, num_floats, calls)
                yield {
                    "layout": str(layout),
                    "num_floats": num_floats,
                    "strategy": strategy,
                    "is_algorithm_1": strategy == chosen,
                    **found,
                    "predicted_s": predicted_s(strategy, layout, num_floats, **bandwidths),
                }


def measure(strategy: str, layout: Layout, num_floats: int, calls: int) -> dict[str, Any]:
    """Runs one job of GMIs that do nothing but reduce; the times of its slowest GMI."""
    machine = detect_machine()
    plan = make_plan(
        PlanConfig(
            gpus=layout.num_gpus,
            gmis_per_gpu=1,
            layout=layout.gmis_of_gpu,
            backend="auto" if layout.num_gpus <= len(machine.gpus) else "cpu",
            sm_percent=None,
            memory_fraction=None,
            template="auto",
        ),
        ReduceConfig(strategy=_known(strategy), intra="host", timeout_s=60),
        1,
        machine,
    )
    with tempfile.TemporaryDirectory() as scratch:
        run = RunPaths(Path(scratch))
        write_json(run.plan, plan.to_dict())
        write_json(run.config, {"num_floats": num_floats, "calls": calls})
        run_gmis(
            Launch(
                plan=plan,
                machine=machine,
                run=run,
                module="benchmarks.reduction_rank",
                patience=PATIENCE,
                compile_once=False,
            )
        )
        found = [read_json(run.gmi(gmi).result) for gmi in layout.gmis]
    return max(found, key=lambda result: result["median_s"])


def line(row: dict[str, Any]) -> str:
    """One row for people."""
    return (
        f"{row['layout']:18} {row['num_floats']:>9,} {row['strategy']:5}"
        f"{'*' if row['is_algorithm_1'] else ' '} {row['median_s'] * 1e3:8.3f} ms"
        f" ({row['p10_s'] * 1e3:.3f} to {row['p90_s'] * 1e3:.3f}),"
        f" predicted {row['predicted_s'] * 1e3:.3f} ms"
    )


def _known(strategy: str) -> Any:
    """The name as a `Literal` of the configuration."""
    if strategy not in COSTS:
        raise ConfigError(f"strategy={strategy}: expected one of {', '.join(COSTS)}")
    return strategy


if __name__ == "__main__":
    sys.exit(main())

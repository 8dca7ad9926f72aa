"""Measures the mean of gradients: `python -m benchmarks.reduction`, without training anything.

Every strategy runs on every layout that it takes, with buffers of three sizes, in real GMIs, all
under one backend. Two large probes give the bandwidths of the cost model, whose prediction stands
beside each measurement. Adds a call to
`benchmarks/results/reduction-<device>.json`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from typing import Any

from benchmarks.evaluation.other_tables import REDUCTION_HEAD, reduction_row
from benchmarks.evaluation.writer import markdown
from benchmarks.records import ResultsFile, device_name, file_name
from benchmarks.reduction_jobs import Probe, candidates, measure
from benchmarks.runner import exit_code, options
from gmijax.collectives.strategies import BYTES_PER_FLOAT, predicted_s
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.layout import Layout
from gmijax.partition.plan import Plan
from gmijax.partition.planner import make_plan
from gmijax.partition.reduction import select_strategy

SIZES = (110_000, 290_000, 1_500_000)
PROBE_FLOATS = 6_000_000
PROBES = {
    "b1": (Layout.even(1, 2), Probe("mpr", "host", PROBE_FLOATS)),
    "b2": (Layout.even(2, 1), Probe("flat", "host", PROBE_FLOATS)),
}
"""With two members every strategy moves M_p bytes, so bandwidth is M_p over time."""

BACKENDS = ("mps", "share", "cpu")
SMALL = ("1G2T", "2G1T", "2G2T")
LAYOUTS = (*SMALL, "2G3T", "4G1T", "4G4T")


def main() -> int:
    """Measures what the command line asks for; returns the exit code."""
    machine, given = detect_machine(), _options()
    backend = given.backend or ("mps" if machine.gpus else "cpu")
    layouts = [layout_of(text) for text in given.layouts or _defaults(machine)]
    if min(*given.sizes, given.calls) < 1:
        raise ConfigError("--sizes, --calls: must be at least 1")
    probed = [layout for layout, _ in PROBES.values()]
    probed = [one for one in probed if one.num_gpus <= (len(machine.gpus) or one.num_gpus)]
    plans = {layout: plan_of(layout, backend, machine) for layout in (*layouts, *probed)}
    path = given.out / file_name("reduction", "cpu" if backend == "cpu" else device_name())
    file = ResultsFile(path, "reduction", {**vars(given), "backend": backend})
    with file.changing() as results:
        results.update(measure_all(plans, set(layouts), machine, given))
    rows = results["rows"]
    cells = [[row["layout"], f"{row['num_floats']:,}", *reduction_row(row)] for row in rows]
    print(*markdown(f"layout | floats: | {REDUCTION_HEAD}", cells), f"written: {path}", sep="\n")
    return 0


def measure_all(
    plans: Mapping[Layout, Plan],
    wanted: set[Layout],
    machine: Machine,
    given: argparse.Namespace,
) -> dict[str, Any]:
    """All rows; one job for each layout, and the bandwidths by two of them."""
    found: list[tuple[Layout, Probe, dict[str, Any]]] = []
    bandwidths: dict[str, float | None] = dict.fromkeys(PROBES)
    for layout, plan in plans.items():
        probes = [p for size in given.sizes for p in candidates(plan, size)]
        probes = probes if layout in wanted else []
        large = {probe: name for name, (at, probe) in PROBES.items() if at == layout}
        rows = measure(plan, machine, [*probes, *large], given.calls)
        for probe, row in zip([*probes, *large], rows, strict=True):
            if "why_not" in row:
                sys.stderr.write(f"{layout} {probe.name}: {row['why_not']}\n")
            elif probe in large:
                bandwidths[large[probe]] = PROBE_FLOATS * BYTES_PER_FLOAT / row["median_s"]
            else:
                found.append((layout, probe, row))
        sys.stderr.write(f"measured: {layout}\n")
    return {
        "probe_floats": PROBE_FLOATS,
        "bytes_per_s": bandwidths,
        "rows": [_row(layout, probe, row, bandwidths) for layout, probe, row in found],
    }


def layout_of(text: str) -> Layout:
    """`2G3T` (2 GPUs, 3 trainers on each) or `[[0,1],[2]]`.

    Raises:
      ConfigError: neither, or no layout.
    """
    gpus, letter, gmis = text.removesuffix("T").partition("G")
    if letter and gpus.isdigit() and gmis.isdigit() and int(gpus) and int(gmis):
        return Layout.even(int(gpus), int(gmis))
    try:
        return Layout(tuple(tuple(map(int, gmis)) for gmis in json.loads(text)))
    except (ValueError, TypeError):
        raise ConfigError(f"--layouts {text}: expected e.g. 2G3T or [[0,1],[2]]") from None


def plan_of(layout: Layout, backend: Any, machine: Machine) -> Plan:
    """A plan of GMIs that train, for `candidates` and `measure`; raises ConfigError."""
    config = PlanConfig(gpus=layout.num_gpus, layout=layout.gmis_of_gpu, backend=backend)
    return make_plan(config, ReduceConfig(), 1, machine)


def _row(
    layout: Layout,
    probe: Probe,
    row: dict[str, Any],
    bandwidths: Mapping[str, float | None],
) -> dict[str, Any]:
    known = {name: value for name, value in bandwidths.items() if value is not None}
    predicted = (
        predicted_s(probe.strategy, layout, probe.num_floats, **known)
        if len(known) == len(PROBES)
        else None
    )
    return {
        "layout": str(layout),
        "name": probe.name,
        **probe._asdict(),
        "is_algorithm_1": probe.strategy == select_strategy(layout).strategy,
        **row,
        "predicted_s": predicted,
    }


def _defaults(machine: Machine) -> tuple[str, ...]:
    """What this machine has GPUs for; without any, what few cores can do."""
    if not machine.gpus:
        return SMALL
    return tuple(t for t in LAYOUTS if layout_of(t).num_gpus <= len(machine.gpus))


def _options() -> argparse.Namespace:
    parser = options("reduction", __doc__)
    parser.add_argument("--layouts", nargs="+", metavar="LAYOUT", help="2G3T or [[0,1],[2]]")
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES, metavar="FLOATS")
    parser.add_argument("--calls", type=int, default=100, help="calls to take the median of")
    parser.add_argument("--backend", choices=BACKENDS, help="of all rows; mps if there are GPUs")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))

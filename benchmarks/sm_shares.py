"""Which SM caps give right matrix products: `python -m benchmarks.sm_shares`, on one GPU.

A GMI for every cap, under an MPS daemon of its own making, compares products in bfloat16, float16,
TF32 and float32 with float64, by cuBLASLt and cuBLAS; then measures, alone, how fast products are.
`--libraries cublaslt cublas xla` adds what XLA chooses by trying, which takes minutes. Adds a
call to `benchmarks/results/sm-shares-<device>.json` and prints a table. On a machine
without a GPU nothing is capped; that tries the machinery only.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.records import RESULTS, ResultsFile, device_name, file_name
from benchmarks.sm_share_rank import LIBRARIES
from gmijax.config import PlanConfig, ReduceConfig
from gmijax.errors import ConfigError, GmiFailed
from gmijax.machine.snapshot import Machine, detect_machine
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.supervise.kinds import JobKind
from gmijax.supervise.launch import Timeouts
from gmijax.supervise.launcher import Launch, run_gmis

SHARES = (
    *(10, 12, 13, 14, 16, 18, 20, 22, 23, 25, 27, 28, 30, 33, 36, 40),
    *(44, 46, 47, 50, 51, 52, 55, 60, 66, 70, 75, 80, 85, 90, 95, 100),
)
AT_ONCE = 16
KINDS = ("bfloat16", "float16", "tf32", "float32")
SIZES = {
    "xla": ((1024, 1024, 1024), (8192, 256, 128)),
    "cublaslt": (
        *((512, 512, 512), (1024, 1024, 1024), (2048, 2048, 2048), (4096, 1024, 4096)),
        *((8192, 256, 128), (16384, 64, 256), (504, 1016, 760)),
    ),
    "cublas": ((1024, 1024, 1024), (2048, 2048, 2048), (8192, 256, 128)),
}
"""(M, K, N) by library; XLA's choice costs seconds a product to find."""

SPEED_SIZE = 4096
SMALL_SIZES = {library: ((128, 128, 128),) for library in SIZES}
TIMEOUTS = Timeouts(start_timeout_s=240, stall_timeout_s=120, stop_timeout_s=30, grace_s=5)


def main() -> int:
    """Measures what the command line asks for; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shares", nargs="+", type=float, default=SHARES, metavar="PERCENT")
    parser.add_argument("--at-once", type=int, default=AT_ONCE, help="GMIs that run together")
    parser.add_argument("--libraries", nargs="+", choices=LIBRARIES, default=LIBRARIES[:2])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    machine = detect_machine()
    path = arguments.out / file_name("sm-shares", device_name())
    book = ResultsFile(path, "sm-shares", vars(arguments))
    rows: list[dict[str, Any]] = []
    try:
        for start in range(0, len(arguments.shares), max(1, arguments.at_once)):
            batch = arguments.shares[start : start + max(1, arguments.at_once)]
            rows += measure_all(batch, arguments.libraries, machine)
            with book.changing() as results:
                results["rows"] = rows
    except ConfigError as error:
        sys.stderr.write(f"benchmarks.sm_shares: {error}\n")
        return 2
    sys.stdout.write("\n".join([*table(rows), f"written: {path}", ""]))
    return int(any("failed" in row for row in rows))


def measure_all(
    shares: Sequence[float], libraries: Sequence[str], machine: Machine
) -> list[dict[str, Any]]:
    """One row for each share; one that ends its GMI is noted, and the others are tried again."""
    left, failed = list(shares), dict[float, str]()
    while left:
        try:
            found = measure(left, libraries, machine)
            break
        except GmiFailed as error:
            failed[left.pop(error.gmi)] = error.reason
    else:
        found = []
    rows = {row["sm_percent"]: row for row in found}
    rows |= {share: {"sm_percent": share, "failed": reason} for share, reason in failed.items()}
    return [rows[share] for share in shares]


def measure(
    shares: Sequence[float], libraries: Sequence[str], machine: Machine
) -> list[dict[str, Any]]:
    """Runs one job with a GMI for each share, all on the first GPU."""
    has_gpu = bool(machine.gpus)
    plan = make_plan(
        PlanConfig(
            gmis_per_gpu=len(shares),
            backend="mps" if has_gpu else "cpu",
            sm_percent=tuple(shares) if has_gpu else None,
            force_sm_percent=True,
        ),
        ReduceConfig(),
        1,
        machine,
    )
    with tempfile.TemporaryDirectory() as scratch:
        run = RunPaths(Path(scratch))
        write_json(run.plan, plan.to_dict())
        sizes = SIZES if has_gpu else SMALL_SIZES
        speed_size = SPEED_SIZE if has_gpu else 256
        write_json(run.config, {"libraries": libraries, "sizes": sizes, "speed_size": speed_size})
        run_gmis(
            Launch(
                plan=plan,
                machine=machine,
                run=run,
                kind=JobKind("benchmarks.sm_share_rank", compile_once=False),
                timeouts=TIMEOUTS,
            )
        )
        found = [read_json(run.gmi(gmi).result) for gmi in plan.layout.gmis]
    return [{"sm_percent": share, **row} for share, row in zip(shares, found, strict=True)]


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """The rows for people, in Markdown."""
    yield f"| cap, % | SMs | {' | '.join(KINDS)} | TFLOP/s bfloat16 | TFLOP/s TF32 |"
    yield f"|{'---|' * (len(KINDS) + 4)}"
    for row in rows:
        if "failed" in row:
            yield f"| {row['sm_percent']:g} | failed: {row['failed']} |"
            continue
        cells = [_verdict(row["products"], kind) for kind in KINDS]
        rates = [f"{rate:.0f}" for rate in row["tflops"].values()]
        shown = [f"{row['sm_percent']:g}", str(row["num_sms"] or "-"), *cells, *rates]
        yield f"| {' | '.join(shown)} |"


def _verdict(products: Sequence[dict[str, Any]], kind: str) -> str:
    """`right`, or which libraries were wrong, and by how much at most."""
    mine = [product for product in products if product["precision"] == kind]
    wrong = [product for product in mine if product["wrong"]]
    if not wrong:
        return "right"
    libraries = dict.fromkeys(product["library"] for product in wrong)
    worst = max(product["error"] for product in wrong)
    return f"WRONG ({', '.join(libraries)}; {worst:.2g})"


if __name__ == "__main__":
    sys.exit(main())

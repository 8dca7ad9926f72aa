"""Faults from a seed, and what became of them: `python -m tests.faults.campaign --faults 300`.

Every fault is a line, and a row of the file of results, which has all that came so far; `--resume`
goes on with it.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

_HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(_HERE), str(_HERE.parent)]

import conftest  # noqa: F401, E402 - the environment of jax, as for tests
from fault_deck import ALL_KINDS, Trial, draw_trials, faults_of, group_of  # noqa: E402
from fault_trials import kinds_here, run_trial  # noqa: E402

from benchmarks.records import RESULTS, ResultsFile  # noqa: E402


def main() -> int:
    """See the module."""
    given = _options()
    end_s = time.monotonic() + 60 * given.minutes
    kinds = [kind for kind in given.kinds.split(",") if kind] or kinds_here()
    if unknown := set(kinds) - set(ALL_KINDS):
        sys.exit(f"--kinds={','.join(sorted(unknown))}: expected one of {', '.join(ALL_KINDS)}")
    trials = list(draw_trials(given.seed, given.faults, kinds))
    settings = {"seed": given.seed, "faults": given.faults, "kinds": given.kinds}
    file = ResultsFile(given.out, "faults", settings, resume=given.resume, device="cpu")
    done = {row["trial"] for row in file.results.get("rows", [])}
    are_good = [True]

    with tempfile.TemporaryDirectory() as folder:
        fixtures = given.fixtures or Path(folder) / "fixtures"

        def run(number: int, trial: Trial) -> None:
            if number in done or time.monotonic() > end_s:
                return
            scratch = Path(folder) / str(number)
            rows = _rows(number, trial, scratch, fixtures)
            with file.changing() as results:
                results["rows"] = [*results.get("rows", []), *rows]
            sys.stdout.write("".join(f"{row}\n" for row in rows))
            sys.stdout.flush()
            are_good.append(is_good := all(map(_is_good, rows)))
            if not is_good and given.keep is not None:
                kept = given.keep / str(number)
                shutil.copytree(scratch, kept, symlinks=True, ignore=_no_file, dirs_exist_ok=True)
            shutil.rmtree(scratch, ignore_errors=True)

        with ThreadPoolExecutor(given.workers) as workers:
            list(workers.map(run, range(len(trials)), trials))
    sys.stdout.writelines(_outcome(file.results.get("rows", [])))
    return 0 if all(are_good) else 1


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faults", type=int, default=300)
    parser.add_argument("--workers", type=int, default=2, help="trials at the same time")
    parser.add_argument("--kinds", default="", help="those alone, with commas between")
    parser.add_argument("--minutes", type=float, default=1e9, help="no trial begins later")
    parser.add_argument("--fixtures", type=Path, help="kept, for the next call")
    parser.add_argument("--keep", type=Path, help="where folders of trials go that went wrong")
    parser.add_argument("--out", type=Path, default=RESULTS / "faults-cpu.json")
    parser.add_argument("--resume", action="store_true", help="go on with the last call of --out")
    return parser.parse_args()


def _rows(number: int, trial: Trial, scratch: Path, fixtures: Path) -> list[dict[str, Any]]:
    began_s = time.monotonic()
    report = run_trial(trial, scratch, fixtures)
    seconds = (time.monotonic() - began_s) / len(faults_of(trial))
    rest = {"trial": number, "seconds": round(seconds, 1)}
    rest |= {"leaked": report.leaks, "lost": report.lost}
    return [{"group": group_of(came.kind), **came._asdict(), **rest} for came in report.came]


def _is_good(row: dict[str, Any]) -> bool:
    return row["outcome"] == "as wanted" and not row["leaked"] and not row["lost"]


def _outcome(rows: list[dict[str, Any]]) -> Iterator[str]:
    trials = {row["trial"]: row for row in rows}
    for what in ("lost", "leaked"):
        yield f"{sum(len(row[what]) for row in trials.values())} {what}, "
    unexpected = sum(row["outcome"] != "as wanted" for row in rows)
    yield f"{unexpected} unexpected of {len(rows)} faults\n"


def _no_file(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "filler" or (Path(folder) / name).is_fifo()]


if __name__ == "__main__":
    sys.exit(main())

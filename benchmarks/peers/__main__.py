"""Training speed beside other libraries: `python -m benchmarks.peers`.

The same training by `gmijax.train` and by Brax's PPO (mjlab: a task that is near), in turn, each
alone on the GPU in processes of its own. Both count alike: steps per second from the first report
behind a fifth of the steps to the last one, and seconds of the whole command. All programs are
compiled before, in short runs at the same time, so no command compiles. Adds a call to
`benchmarks/results/peers-<device>.json`, after every run. Overrides that are given change both
sides, e.g. `num_envs=8192`. Comparisons that lack a package are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.command import STOP_S, start, wait_until
from benchmarks.evaluation.figures import markdown
from benchmarks.peers.comparisons import COMPARISONS, MJLAB, missing_package
from benchmarks.peers.side import Side
from benchmarks.peers.table import HEAD, OURS, row
from benchmarks.records import RESULTS, ResultsFile, device_name, file_name
from benchmarks.steady import settled_rate
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.supervise.failures import last_line

CURVE_POINTS = 60


class Benchmark:
    """The runs of one call, in its file after each of them."""

    def __init__(
        self, arguments: argparse.Namespace, scratch: Path, sides: Sequence[Side]
    ) -> None:
        self._arguments, self._scratch = arguments, scratch
        self._has_gpu = bool(detect_machine().gpus)
        self._deadline_s = time.monotonic() + (arguments.deadline_s or math.inf)
        self._took_s: dict[Side, float] = {}
        self._sides = list(sides)
        path = arguments.out / file_name("peers", device_name())
        self.file = ResultsFile(path, "peers", vars(arguments))
        cases = self.file.results.setdefault("cases", {})
        self._runs: dict[Side, list[dict[str, Any]]] = {side: [] for side in sides}
        for side in sides:
            cases[str(side)] = {"told": side.told, "runs": self._runs[side]}

    @property
    def has_failed(self) -> bool:
        """Whether a run has failed."""
        return any("failed" in run for runs in self._runs.values() for run in runs)

    def run(self) -> None:
        """Compiles, then runs every side as often as wanted, all once before one comes twice."""
        at_once = max(1, (os.cpu_count() or 1) // 2)
        for first in range(0, len(self._sides), at_once):
            self._compile(self._sides[first : first + at_once])
        for repeat in range(self._arguments.repeats):
            for side in self._sides:
                if self._has_time(side):
                    self._add(side, self._run(side, repeat))

    def _compile(self, sides: Sequence[Side]) -> None:
        """Short runs at the same time; a side that fails is not tried again."""
        folders = [self._new_folder(side, "compile") for side in sides]
        with ExitStack() as logs:
            processes = []
            for side, folder in zip(sides, folders, strict=True):
                log = logs.enter_context((folder / "log").open("wb"))
                command = side.short_command(folder, has_gpu=self._has_gpu)
                processes.append(start(command, self._variables(side, is_short=True), log))
            codes = wait_until(self._training_deadline_s(), *processes)
        for side, folder, code in zip(sides, folders, codes, strict=True):
            if code:
                self._add(side, {"repeat": 0, "failed": self._reason(folder, code)})
                self._sides.remove(side)

    def _run(self, side: Side, repeat: int) -> dict[str, Any]:
        """One training as a whole command."""
        folder, started_s = self._new_folder(side, str(repeat)), time.monotonic()
        with (folder / "log").open("wb") as log:
            command = side.command(folder, seed=repeat)
            process = start(command, self._variables(side, is_short=False), log)
            code = wait_until(self._training_deadline_s(), process)[0]
        self._took_s[side] = command_s = time.monotonic() - started_s
        curve = side.curve(folder) if code == 0 else []
        rate = settled_rate(curve) if curve else None
        if rate is None:
            return {"repeat": repeat, "failed": self._reason(folder, code)}
        summary = {"steps_per_s": rate, "command_s": command_s, "env_steps": curve[-1][1]}
        kept = curve[:: max(1, len(curve) // CURVE_POINTS)]
        return {"repeat": repeat, "summary": summary, "curve": kept}

    def _add(self, side: Side, run: dict[str, Any]) -> None:
        with self.file.changing():
            self._runs[side].append(run)
        shown = run.get("summary") or {"failed": run["failed"]}
        sys.stdout.write(f"{side}: {json.dumps(shown)}\n")
        sys.stdout.flush()

    def _variables(self, side: Side, *, is_short: bool) -> dict[str, str]:
        return side.variables(self._scratch / "xla", is_short=is_short)

    def _reason(self, folder: Path, code: int) -> str:
        if time.monotonic() > self._deadline_s - STOP_S:
            return "ended by the deadline"
        return last_line(folder / "log") or f"exit code {code}"

    def _new_folder(self, side: Side, what: str) -> Path:
        name = re.sub(r"[^a-zA-Z0-9]+", "-", f"{side} {what}")  # A value on a command line.
        self._scratch.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._scratch))

    def _training_deadline_s(self) -> float:
        return min(self._deadline_s, time.monotonic() + self._arguments.timeout_s + STOP_S)

    def _has_time(self, side: Side) -> bool:
        return time.monotonic() + self._took_s.get(side, 0.0) < self._deadline_s - STOP_S


def main() -> int:
    """Measures what the command line asks for; returns 1 if a run failed, 2 on bad input."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments = _arguments()
    try:
        more = tuple(arguments.overrides)
        sides = list(wanted_sides(arguments.only or [], more, arguments.mjlab))
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    if not sides:
        return 1
    code = 0
    with tempfile.TemporaryDirectory() as scratch:
        benchmark = Benchmark(arguments, (arguments.runs or Path(scratch)).absolute(), sides)
        try:
            benchmark.run()
        except KeyboardInterrupt:
            code = 130
    results = benchmark.file.results
    rows = [row(results, name) for name in dict.fromkeys(side.comparison for side in sides)]
    sys.stdout.writelines(f"{line}\n" for line in markdown(HEAD, rows))
    return code or int(benchmark.has_failed)


def wanted_sides(
    only: Sequence[str], more: tuple[str, ...], mjlab: str | None = None
) -> Iterator[Side]:
    """Both sides of the comparisons with one of `only` in the name, of those to be had here.

    `mjlab` is the interpreter of an environment that has it.

    Raises:
      ConfigError: no comparison has that in its name, or an override is wrong.
    """
    for text in only:
        if not any(text in name for name in COMPARISONS):
            raise ConfigError(f"--only {text!r}: in no name; names are {'; '.join(COMPARISONS)}")
    wanted = [name for name in COMPARISONS if any(text in name for text in only or [""])]
    for name in wanted:
        peer = COMPARISONS[name].peer
        if package := missing_package(COMPARISONS[name], more):
            sys.stderr.write(f"{name}: left out, the package {package} is not installed\n")
            continue
        if peer == MJLAB and mjlab is None:
            sys.stderr.write(f"{name}: left out, give --mjlab the python of where mjlab is\n")
            continue
        for side in (Side(name, trainer, more, mjlab or "") for trainer in (OURS, peer)):
            _ = side.told  # Composes it, so that a wrong override is found now.
            yield side


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("overrides", nargs="*", help="of both sides, e.g. num_envs=8192")
    parser.add_argument(
        "--only", action="append", metavar="TEXT", help="comparisons with TEXT in the name"
    )
    parser.add_argument(
        "--mjlab", metavar="PYTHON", help="interpreter of an environment with mjlab"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--timeout-s", type=float, default=600.0, help="seconds for a run")
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--runs", type=Path, help="keep the folders of runs, with logs, here")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(main())

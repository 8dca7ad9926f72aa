"""Training speed beside other libraries: `python -m benchmarks.peers`.

The same training by `gmijax.train` and by Brax's PPO (or by mjlab: a task that is near; or by
FastTD3, beside our SAC), in turn, each alone on the GPU in processes of its own. Both count alike:
steps per second from the first report behind a fifth of the steps to the last one, and seconds of
the whole command. All programs are compiled before, in short runs at the same time, so no command
compiles. Adds a call to `benchmarks/results/peers-<device>.json`, after every run. Overrides that
are given change both sides, e.g. `num_envs=8192`. Comparisons that lack a package are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.evaluation.peer_tables import HEAD, row
from benchmarks.evaluation.writer import markdown
from benchmarks.peers.comparisons import (
    COMPARISONS,
    FAST_TD3,
    MJLAB,
    OURS,
    missing_package,
)
from benchmarks.peers.side import Side
from benchmarks.records import results_file
from benchmarks.runner import (
    STOP_S,
    Command,
    as_word,
    deadline,
    exit_code,
    failures_of,
    in_turn,
    options,
)
from benchmarks.steady import settled_rate
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine

CURVE_POINTS = 60
_PLACES: Mapping[str, str] = MappingProxyType(
    {
        MJLAB: "--mjlab the python of where mjlab is",
        FAST_TD3: "--fast-td3 the folder of its checkout",
    }
)
"""What has to be given for a peer that is not a package of this environment."""


class Benchmark:
    """The runs of one call, in its file after each of them."""

    def __init__(self, given: argparse.Namespace, scratch: Path, sides: Sequence[Side]) -> None:
        self._given, self._scratch, self._sides = given, scratch, list(sides)
        self._deadline_s = deadline(given.deadline_s)
        self.file = results_file(given, "peers")
        self._runs: dict[Side, list[dict[str, Any]]] = {side: [] for side in sides}
        self.file.results["cases"] = {
            # The key of the settings as in the calls that are already in the file.
            str(side): {"told": side.settings, "runs": runs}
            for side, runs in self._runs.items()
        }

    @property
    def has_failed(self) -> bool:
        """Whether a run has failed."""
        return any("failed" in run for runs in self._runs.values() for run in runs)

    def run(self) -> None:
        """Compiles, then runs every side as often as wanted, each once before any is repeated."""
        at_once = max(1, (os.cpu_count() or 1) // 2)
        for first in range(0, len(self._sides), at_once):
            self._compile(self._sides[first : first + at_once])
        for repeat, side in in_turn(self._sides, self._given.repeats, self._deadline_s):
            self._add(side, self._run(side, repeat))

    def _compile(self, sides: Sequence[Side]) -> None:
        """Short runs at the same time; a side that fails is not tried again."""
        has_gpu = bool(detect_machine().gpus)
        folders = [self._new_folder(side, "compile") for side in sides]
        commands = [
            self._command(side, side.short_command(folder, has_gpu=has_gpu), folder, is_short=True)
            for side, folder in zip(sides, folders, strict=True)
        ]
        for side, failure in zip(sides, self._failures(*commands), strict=True):
            if failure:
                self._add(side, {"repeat": 0, "failed": failure})
                self._sides.remove(side)

    def _run(self, side: Side, repeat: int) -> dict[str, Any]:
        """One training as a whole command."""
        folder, started_s = self._new_folder(side, str(repeat)), time.monotonic()
        command = self._command(side, side.command(folder, seed=repeat), folder)
        (failure,) = self._failures(command)
        command_s = time.monotonic() - started_s
        curve = [] if failure else side.curve(folder)
        rate = settled_rate(curve) if curve else None
        if rate is None:
            return {"repeat": repeat, "failed": failure or "too few reports"}
        summary = {"steps_per_s": rate, "command_s": command_s, "env_steps": curve[-1][1]}
        return {
            "repeat": repeat,
            "summary": summary,
            "curve": _thinned(curve),
            "returns": _thinned(side.returns(folder)),
        }

    def _command(
        self, side: Side, words: Sequence[str], folder: Path, *, is_short: bool = False
    ) -> Command:
        return Command(words, folder, side.variables(self._scratch / "xla", is_short=is_short))

    def _failures(self, *commands: Command) -> list[str | None]:
        found = failures_of(
            commands, min(self._deadline_s, deadline(self._given.timeout_s + STOP_S))
        )
        is_over = time.monotonic() > self._deadline_s - STOP_S
        return ["ended by the deadline" if one and is_over else one for one in found]

    def _add(self, side: Side, run: dict[str, Any]) -> None:
        with self.file.changing():
            self._runs[side].append(run)
        shown = run.get("summary") or {"failed": run["failed"]}
        print(f"{side}: {json.dumps(shown)}", flush=True)

    def _new_folder(self, side: Side, what: str) -> Path:
        self._scratch.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=as_word(f"{side} {what} "), dir=self._scratch))


def main() -> int:
    """Measures what the command line asks for; returns 1 if a run failed, else 0."""
    given = _options()
    sides = list(wanted_sides(given.only or [], tuple(given.overrides), _places(given)))
    if not sides:
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        benchmark = Benchmark(given, (given.runs or Path(scratch)).absolute(), sides)
        try:
            benchmark.run()
        finally:
            names = dict.fromkeys(side.comparison for side in sides)
            rows = [row(benchmark.file.results, name) for name in names]
            sys.stdout.writelines(f"{line}\n" for line in markdown(HEAD, rows))
    return int(benchmark.has_failed)


def wanted_sides(
    only: Sequence[str], more: tuple[str, ...], places: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Side]:
    """Both sides of the comparisons with one of `only` in the name, of those to be had here.

    `places` has the path of each peer that is not a package of this environment, see `Side`.

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
        if peer in _PLACES and peer not in places:
            sys.stderr.write(f"{name}: left out, give {_PLACES[peer]}\n")
            continue
        for side in (Side(name, trainer, more, places.get(peer, "")) for trainer in (OURS, peer)):
            _ = side.settings  # Composes them, so that a wrong override is found now.
            yield side


def _thinned(points: list[Any]) -> list[Any]:
    return points[:: max(1, len(points) // CURVE_POINTS)]


def _places(given: argparse.Namespace) -> dict[str, str]:
    """Where the peers are, of those that were given; FastTD3's folder has to have its script."""
    if given.fast_td3 and not (given.fast_td3 / "fast_td3" / "train.py").is_file():
        raise ConfigError(f"--fast-td3={given.fast_td3}: has no fast_td3/train.py")
    places = {MJLAB: given.mjlab, FAST_TD3: given.fast_td3}
    return {peer: str(place) for peer, place in places.items() if place}


def _options() -> argparse.Namespace:
    parser = options("peers", __doc__)
    parser.add_argument("overrides", nargs="*", help="of both sides, e.g. num_envs=8192")
    parser.add_argument(
        "--only", action="append", metavar="TEXT", help="comparisons with TEXT in the name"
    )
    parser.add_argument(
        "--mjlab", metavar="PYTHON", help="interpreter of an environment with mjlab"
    )
    parser.add_argument(
        "--fast-td3", type=Path, metavar="FOLDER", help="checkout of younggyoseo/FastTD3"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--timeout-s", type=float, default=600.0, help="seconds for a run")
    parser.add_argument("--deadline-s", type=float, help="seconds for all of it")
    parser.add_argument("--runs", type=Path, help="keep the folders of runs, with logs, here")
    return parser.parse_intermixed_args()


if __name__ == "__main__":
    sys.exit(exit_code(main))

"""The table of how long robots are trained until they walk."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from benchmarks.evaluation.evidence import source
from benchmarks.evaluation.figures import NOT_MEASURED, Figure
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.records import Call, calls_by_date
from benchmarks.walking import OURS, SCRIPT, is_tested, summary
from gmijax.sim.robots import robot_name

Kind: TypeAlias = tuple[str, str, str, str | None, bool]
"""Task or robot, algorithm of our trainings as it is written, physics, GPU, and start."""

FoundCall: TypeAlias = tuple[Call, Path]

_FILES = "walking-*-nvidia-*.json"


def _calls() -> dict[tuple[Kind, bool], FoundCall]:
    """Of each kind the call with the most seeds, and one with Playground's script besides."""
    known = calls_by_date(_FILES)
    most = _with_most_seeds(known)
    with_script = _with_most_seeds([one for one in known if SCRIPT in _rows(one[0])])
    more = {(kind, True): one for kind, one in with_script.items() if one != most[kind]}
    return {(kind, False): one for kind, one in most.items()} | more


def _with_most_seeds(known: Sequence[FoundCall]) -> dict[Kind, FoundCall]:
    """Of each kind the call with the most seeds of ours; of those the newest."""
    ascending = sorted(known, key=lambda one: _rows(one[0])[OURS]["seeds"])
    return {_kind_of(call): (call, path) for call, path in ascending}


def _rows(call: Call) -> dict[str, Any]:
    """When those of each trainer walk."""
    return summary(call.results["runs"])


def _kind_of(call: Call) -> Kind:
    assert call.settings is not None
    given = dict(word.split("=", 1) for word in call.settings["overrides"])
    algo = given.get("algo", "ppo").upper()
    task = call.results["task"]
    robot = robot_name(task.removeprefix("playground/"))
    return robot or task, algo, _physics(call, OURS), call.device, call.settings["cold"]


@table_of_calls(
    "walking",
    "task | MJX | trained by | commit | programs | seeds that walk: | million steps: | "
    "seconds of training: | seconds of the command: | at the end: million steps: | "
    "do not fall: | error, m/s: | rad/s:",
    _calls,
)
def walking(calls: Calls) -> Rows:
    """How long robots are trained until they walk: median, least and most of seeds."""
    for ((task, algo, _, _, is_cold), _), (call, _) in sorted(calls.items()):
        start = "compiled anew" if is_cold else "from the cache"
        for trainer, row in _rows(call).items():
            name = trainer if trainer == SCRIPT else f"{trainer} {algo}"
            spreads = (
                _spread(row["env_steps"], 1e-6),
                *(_spread(row[key]) for key in ("training_s", "command_s")),
            )
            about = [f"`{task}`", _physics(call, trainer), name, call.commit, start, _walk(row)]
            yield [*about, *spreads, *_last_tests(call, trainer)]


def _physics(call: Call, trainer: str) -> str:
    """The MJX implementation that this trainer's policies were trained and tested with."""
    tests = (test for run in _runs_of(call, trainer) for test in _tests_of(run))
    return next((test["walk"]["impl"] for test in tests), "")


def _runs_of(call: Call, trainer: str) -> list[Mapping[str, Any]]:
    return [run for run in call.results["runs"] if run["trainer"] == trainer]


def _tests_of(run: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The tested checkpoints of a training."""
    return [one for one in run["checkpoints"] if "walk" in one]


def seconds_until_it_walks(task: str, impl: str) -> tuple[Figure | None, str]:
    """By SAC with the most seeds, compiled before: seconds of training, and how many walk."""
    wanted = (task, "SAC", impl, False)
    calls = _with_most_seeds(calls_by_date(_FILES))
    found = next((calls[kind] for kind in calls if (*kind[:3], kind[4]) == wanted), None)
    if found is None:
        return None, NOT_MEASURED
    call, path = found
    row = _rows(call)[OURS]
    if row["training_s"] is None:
        return None, _walk(row)
    low, median, high = row["training_s"]
    evidence = frozenset([source(path.stem, call)])
    return Figure(median, low, high, row["seeds"], evidence), _walk(row)


def _walk(row: Mapping[str, Any]) -> str:
    more = f", {row['untested']} not tested" if row["untested"] else ""
    return f"{row['walk']} of {row['seeds']}{more}"


def _last_tests(call: Call, trainer: str) -> Iterator[str]:
    """The last test of every training whose tests came to their end: medians over seeds."""
    tested = map(_tests_of, filter(is_tested, _runs_of(call, trainer)))
    last = [tests[-1] for tests in tested if tests]
    settled = [one["walk"]["settled"] for one in last]
    for form, values in (
        (".0f", [one["env_steps"] / 1e6 for one in last]),
        (".1%", [one["walk"]["upright"] for one in last]),
        (".2f", [errors["linear_m_per_s"] for errors in settled]),
        (".2f", [errors["yaw_rad_per_s"] for errors in settled]),
    ):
        # None: all have left the field, or fallen at once.
        known = [value for value in values if value is not None]
        yield format(statistics.median(known), form) if known else ""


def _spread(values: Sequence[float] | None, scale: float = 1.0) -> str:
    if values is None:
        return ""
    least, median, most = (f"{value * scale:.0f}" for value in values)
    return f"{median} ({least} to {most})"

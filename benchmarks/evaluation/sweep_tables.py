"""Sweeps: steps/s and trainings per hour by how many jobs run at once."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from benchmarks.evaluation.evidence import Ratio, Source, source
from benchmarks.evaluation.figures import NOT_MEASURED, Figure, figure, over, shown
from benchmarks.evaluation.writer import line_of, lines, markdown
from benchmarks.records import Call, calls_by_date

PATTERN = "sweeps-nvidia-*.json"
ONE, EIGHT, PROGRAM = "1 at once, auto", "8 at once, auto", "8 at once, vmap"
STEPS, FINISHED = "steady_steps_per_s", "trainings_per_hour"
KEYS = MappingProxyType({"steps": STEPS, "finished": FINISHED})
HEAD = (
    "commit | at once | steps/s in all: | over one after another: | over one program: "
    "| trainings per hour: | over one after another: | over one program:"
)

Run: TypeAlias = Mapping[str, Any]


class SweepsOfCall(NamedTuple):
    """The sweeps of one call, all of the same jobs.

    Attributes:
      commit: of the code.
      line: the call, in Markdown.
      made_by: the call.
      ways: what succeeded, by how many ran at once and how.
    """

    commit: str
    line: str
    made_by: Source
    ways: dict[str, list[Run]]

    def rate(self, way: str, key: str) -> Figure | None:
        """The median over its sweeps of one way."""
        values = [run[key] for run in self.ways.get(way, ()) if run[key] is not None]
        return figure(values, self.made_by)

    def gain(self, way: str, base: str, key: str) -> Ratio | None:
        """One way over another."""
        return None if way == base else over(self.rate(way, key), self.rate(base, key))


def same_jobs() -> dict[str, list[SweepsOfCall]]:
    """By what the jobs are and where they ran, in Markdown; in the order of first calls."""
    found: dict[str, list[SweepsOfCall]] = {}
    for call, path in calls_by_date(PATTERN):
        by_jobs: dict[str, dict[str, list[Run]]] = {}
        for run in call.results["runs"]:
            at_once, backend, *tasks = run["way"].split(", ")
            if run["status"] == "completed":
                ways = by_jobs.setdefault(_described(call, tasks), {})
                ways.setdefault(f"{at_once}, {backend}", []).append(run)
        for jobs, ways in by_jobs.items():
            one = SweepsOfCall(
                (call.commit or "unknown")[:8],
                line_of(path.name, call),
                source(path.stem, call),
                ways,
            )
            found.setdefault(jobs, []).append(one)
    return found


def eight_at_once(key: str) -> Ratio | None:
    """What eight jobs gain in eight processes, over one after another."""
    return _gain_of_one_call(ONE, key)


def processes_over_program(key: str) -> Ratio | None:
    """Eight jobs in eight processes, over the same jobs as one program."""
    return _gain_of_one_call(PROGRAM, key)


def _gain_of_one_call(base: str, key: str) -> Ratio | None:
    """Of the call with the most sweeps of both, of those the newest."""
    found = [
        (gain.evidence.repeats, number, gain)
        for calls in same_jobs().values()
        for number, one in enumerate(calls)
        if (gain := one.gain(EIGHT, base, key))
    ]
    return max(found, key=lambda one: one[:2])[2] if found else None


@lines("sweeps")
def sweeps() -> list[str]:
    """Every call of sweeps, where there is one: ratios are of the sweeps of a call."""
    found: list[str] = []
    for jobs, calls in same_jobs().items():
        rows = [_row(one, way) for one in calls for way in sorted(one.ways, key=_order)]
        below = dict.fromkeys(one.line for one in calls)
        found += [jobs, "", *markdown(HEAD, rows), "", *below, ""]
    return found[:-1] or [
        f"Trainings per hour of a sweep: {NOT_MEASURED} (`python -m benchmarks.sweeps`)."
    ]


def _row(one: SweepsOfCall, way: str) -> list[str]:
    cells = [one.commit, _named(way)]
    for key, form in ((STEPS, ",.0f"), (FINISHED, ".1f")):
        gains = (one.gain(way, base, key) for base in (ONE, PROGRAM))
        cells += [
            shown(one.rate(way, key), form),
            *("" if gain is None else shown(gain) for gain in gains),
        ]
    return cells


def _named(way: str) -> str:
    at_once, backend = way.split(" at once, ")
    if backend == "vmap":
        return f"{at_once} in one program"
    if at_once == "1":
        return "one after another"
    count = "as many as `auto` takes" if at_once == "auto" else f"{at_once} processes"
    return count if backend == "auto" else f"{count}, `{backend}`"


def _described(call: Call, tasks: list[str]) -> str:
    assert call.settings is not None
    overrides = ", ".join(f"`{one}`" for one in sorted(call.settings["overrides"]))
    mix = f" of {tasks[0].replace(',', ', ')}" if tasks else ""
    compiled = "programs compiled before" if call.settings["warm"] else "each sweep compiles"
    runs = f"{call.settings['jobs']} training runs{mix} with {overrides}"
    return f"{runs}; {compiled}; {call.device}."


def _order(way: str) -> tuple[str, int]:
    at_once, backend = way.split(" at once, ")
    return backend, int(at_once) if at_once.isdigit() else 99

"""Training runs per hour of sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, TypeVar

from benchmarks.evaluation.evidence import Ratio, Source, source
from benchmarks.evaluation.figures import NOT_MEASURED, Figure, figure, over, shown
from benchmarks.evaluation.writer import line_of, lines, markdown
from benchmarks.records import Call, calls_by_date

PATTERN = "sweeps-nvidia-*.json"
ONE_AFTER_ANOTHER = "1 at once, auto"
STEPS, FINISHED = "steady_steps_per_s", "trainings_per_hour"
KEYS = MappingProxyType({"steps": STEPS, "finished": FINISHED})
HEAD = (
    "at once | sweeps: | runs per hour: | over one after another: | over plain sharing: | "
    "steps/s in all:"
)

Run: TypeAlias = Mapping[str, Any]
Key = TypeVar("Key")


class SameJobs(NamedTuple):
    """Sweeps of the same jobs on the same GPU; a call has time for one of each way or so.

    Attributes:
      calls: that ran them, as lines of Markdown.
      runs: the number of the call, the way, and what succeeded in it.
      sources: the calls.
    """

    calls: list[str]
    runs: list[tuple[int, str, Run]]
    sources: list[Source]

    def rates(self, key: str = FINISHED) -> dict[str, Figure]:
        """A figure of all sweeps, by way."""
        return _figures(((way, run[key]) for _, way, run in self.runs), self.sources)

    def gains(self, key: str = FINISHED) -> dict[str, Figure]:
        """A figure over that of one after another, each ratio of one call."""
        return self._ratios(lambda way: ONE_AFTER_ANOTHER, key)

    def gains_over_sharing(self) -> dict[str, Figure]:
        """Jobs per hour over those of as many at once under plain sharing."""
        return self._ratios(lambda way: way.replace(", auto", ", share"), FINISHED)

    def of_calls(self, key: str) -> dict[tuple[int, str], Figure]:
        """Figures by call and way."""
        return _figures((((call, way), run[key]) for call, way, run in self.runs), self.sources)

    def _ratios(self, base_of: Callable[[str], str], key: str) -> dict[str, Figure]:
        of_call = self.of_calls(key)
        gains = (
            (way, found.median / of_call[number, base].median)
            for (number, way), found in of_call.items()
            if (base := base_of(way)) != way and (number, base) in of_call
        )
        return _figures(gains, self.sources)


def _figures(
    values: Iterable[tuple[Key, float | None]], sources: Sequence[Source]
) -> dict[Key, Figure]:
    """Those with the same key together, without what has no value."""
    together: dict[Key, list[float]] = {}
    for key, value in values:
        if value is not None:
            together.setdefault(key, []).append(value)
    return {key: median for key, found in together.items() if (median := figure(found, *sources))}


def same_jobs() -> dict[str, SameJobs]:
    """By what the jobs are and where they ran, in Markdown; in the order of first calls."""
    found: dict[str, SameJobs] = {}
    for number, (call, path) in enumerate(calls_by_date(PATTERN)):
        for run in call.results["runs"]:
            at_once, backend, *tasks = run["way"].split(", ")
            if run["status"] == "completed":
                same = found.setdefault(_described(call, tasks), SameJobs([], [], []))
                if number not in {one for one, *_ in same.runs}:
                    same.calls.append(line_of(path.name, call))
                    same.sources.append(source(path.stem, call))
                same.runs.append((number, f"{at_once}, {backend}", run))
    return found


def eight_at_once(key: str) -> Figure | None:
    """What eight of the jobs of the first call gain at once, over one after another."""
    gains = next((same.gains(key) for same in same_jobs().values()), {})
    return gains.get("8 at once, auto")


def processes_over_program(key: str) -> Ratio | None:
    """Eight jobs in eight processes, over the same jobs as one program.

    Of one call: the one with the most sweeps, of those the newest.
    """
    rates = [same.of_calls(key) for same in same_jobs().values()]
    found = [
        (gain.evidence.repeats, call, gain)
        for of_calls in rates
        for call, way in of_calls
        if way == "8 at once, vmap"
        and (gain := over(of_calls.get((call, "8 at once, auto")), of_calls[call, way]))
    ]
    return max(found, key=lambda one: one[:2])[2] if found else None


@lines("sweeps")
def sweeps() -> list[str]:
    """Training runs per hour, where they were measured."""
    found: list[str] = []
    for what, same in same_jobs().items():
        gains, sharing = same.gains(), same.gains_over_sharing()
        steps = same.rates(STEPS)
        rows = [
            [
                way,
                str(rate.repeats),
                shown(rate, ".1f"),
                "1" if way == ONE_AFTER_ANOTHER else shown(gains[way]) if way in gains else "-",
                shown(sharing[way]) if way in sharing else "-",
                shown(steps.get(way), ",.0f"),
            ]
            for way, rate in sorted(same.rates().items(), key=lambda row: _order(row[0]))
        ]
        found += [what, "", *markdown(HEAD, rows), "", *same.calls, ""]
    return found[:-1] or [
        f"Training runs per hour of a sweep: {NOT_MEASURED} (`python -m benchmarks.sweeps`)."
    ]


def _described(call: Call, tasks: list[str]) -> str:
    assert call.settings is not None
    overrides = ", ".join(f"`{one}`" for one in sorted(call.settings["overrides"]))
    mix = f" of {tasks[0].replace(',', ', ')}" if tasks else ""
    compiled = "programs compiled before" if call.settings["warm"] else "each sweep compiles"
    runs = f"{call.settings['jobs']} training runs{mix} with {overrides}"
    return f"{runs}; {compiled}; {call.device}."


def _order(way: str) -> tuple[str, int]:
    at_once, backend = way.split(" at once, ")
    return backend, int(at_once) if at_once.isdigit() else 0

"""Training runs per hour of sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from benchmarks.evaluation.figures import NOT_MEASURED, Figure, figure, over, shown
from benchmarks.evaluation.writer import lines, link, markdown, origin
from benchmarks.records import Call, calls_by_date

PATTERN = "sweeps-nvidia-*.json"
ONE_AFTER_ANOTHER = "1 at once, auto"
HEAD = (
    "at once | sweeps: | runs per hour: | over one after another: | over plain sharing: | "
    "steps/s in all:"
)

Run: TypeAlias = Mapping[str, Any]


class SameJobs(NamedTuple):
    """Sweeps of the same jobs on the same GPU; a call has time for one of each way or so.

    Attributes:
      calls: that ran them, as lines of Markdown.
      runs: of each of the calls, those that succeeded, by way.
    """

    calls: list[str]
    runs: list[dict[str, list[Run]]]

    def rates(self, key: str = "trainings_per_hour") -> dict[str, Figure]:
        """A figure of all sweeps, by way."""
        return _figures(_by_way(key, runs) for runs in self.runs)

    def gains(self, key: str = "trainings_per_hour") -> dict[str, Figure]:
        """A figure over that of one after another, each ratio of one call."""
        return self._ratios(lambda way: ONE_AFTER_ANOTHER, key)

    def gains_over_sharing(self) -> dict[str, Figure]:
        """Jobs per hour over those of as many at once under plain sharing."""
        return self._ratios(lambda way: way.replace(", auto", ", share"), "trainings_per_hour")

    def _ratios(self, base: Callable[[str], str], key: str) -> dict[str, Figure]:
        ratios: list[dict[str, list[float]]] = []
        for runs in self.runs:
            rates = _figures([_by_way(key, runs)])
            ratios.append(
                {
                    way: [rate.median / rates[base(way)].median]
                    for way, rate in rates.items()
                    if base(way) in rates and base(way) != way
                }
            )
        return _figures(ratios)


def same_jobs() -> dict[str, SameJobs]:
    """By what the jobs are and where they ran, in Markdown; in the order of first calls."""
    found: dict[str, SameJobs] = {}
    for call, path in calls_by_date(PATTERN):
        here: dict[str, dict[str, list[Run]]] = {}
        for run in call.results["runs"]:
            at_once, backend, *tasks = run["way"].split(", ")
            if run["status"] == "completed":
                by_way = here.setdefault(_described(call, tasks), {})
                by_way.setdefault(f"{at_once}, {backend}", []).append(run)
        for what, by_way in here.items():
            same = found.setdefault(what, SameJobs([], []))
            same.calls.append(f"- {link(path.name)}: {origin(call)}")
            same.runs.append(by_way)
    return found


def first_gains(key: str = "trainings_per_hour") -> dict[str, Figure]:
    """What the jobs of the first call gain at once, over one after another."""
    return next((same.gains(key) for same in same_jobs().values()), {})


def program_over_processes(key: str) -> float | None:
    """Eight jobs as one program, over the same jobs in eight processes."""
    rates = next((same.rates(key) for same in same_jobs().values()), {})
    return over(rates.get("8 at once, vmap"), rates.get("8 at once, auto"))


@lines("sweeps")
def sweeps() -> list[str]:
    """Training runs per hour, where they were measured."""
    found: list[str] = []
    for what, same in same_jobs().items():
        gains, sharing = same.gains(), same.gains_over_sharing()
        steps = same.rates("steady_steps_per_s")
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


def _by_way(key: str, runs: Mapping[str, Iterable[Run]]) -> dict[str, list[float]]:
    """A figure of the sweeps of a call, by way; without those that have none."""
    return {
        way: [run[key] for run in of_way if run[key] is not None] for way, of_way in runs.items()
    }


def _figures(found: Iterable[dict[str, list[float]]]) -> dict[str, Figure]:
    """What several calls measured, together."""
    together: dict[str, list[float]] = {}
    for one in found:
        for way, values in one.items():
            together.setdefault(way, []).extend(values)
    return {way: median for way, values in together.items() if (median := figure(values))}

"""The tables of serving: GMIs that simulate and infer, in one process or several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from benchmarks.evaluation.evidence import Evidence, Ratio, source
from benchmarks.evaluation.figures import Figure, figure, over, shown
from benchmarks.evaluation.writer import Calls, Rows, table_of_calls
from benchmarks.paper_model import Task, serving_gain
from benchmarks.records import Call, calls_by_date

Case: TypeAlias = Mapping[str, Any]

TASKS = ("ant", "ball_balance", "humanoid")
GMIS = (2, 3, 4, 8)
"""That share 8192 environments."""


def _newest(is_wanted: Callable[[Sequence[Case]], object]) -> Calls:
    """By task, the newest call whose cases of it are wanted."""
    calls = calls_by_date("serving-*nvidia-*.json")
    return {task: one for one in calls for task in TASKS if is_wanted([*_cases({task: one})])}


def _cases(calls: Calls) -> Iterator[Case]:
    """That succeeded, of the task of each call."""
    for task, (call, _) in sorted(calls.items()):
        yield from (case for case in call.results["cases"] if case.get("task") == task)


def _of_backends() -> Calls:
    return _newest(lambda cases: [one for one in cases if one["backend"] == "share"])


def _of_templates() -> Calls:
    return _newest(lambda cases: [one for one in cases if "simulator_s" in one])


def _of_peaks() -> Calls:
    """With several numbers of environments, in one process and in GMIs."""
    return _newest(_sides)


def _sides(cases: Sequence[Case]) -> list[list[Case]]:
    """Cases of a task in one process and in GMIs; nothing if they have one size."""
    mine = [case for case in cases if "colocated" in case]
    sides = [[case for case in mine if (case["simulators"] > 1) == gmis] for gmis in (False, True)]
    sizes = {case["simulators"] * case["num_envs"] for case in mine}
    return sides if all(sides) and len(sizes) > 1 else []


def _case(task: str, gmis: int, backend: str) -> Case | None:
    name = f"{task} {gmis} x {8192 // gmis}, {backend}"
    return next((case for case in _cases(_of_backends()) if case["name"] == name), None)


def serving_rate(task: str, gmis: int, backend: str = "mps") -> Figure | None:
    """Steps/s of serving in GMIs that share 8192 environments."""
    case = _case(task, gmis, backend)
    return _rate(case, _of_backends()[task]) if case else None


def _rate(case: Case, made_by: tuple[Call, Path]) -> Figure | None:
    call, path = made_by
    rates = [run["step_per_s_inference"] for run in case["runs"]["tcg"]]
    return figure(rates, source(path.stem, call))


def mps_over_share(task: str, gmis: int) -> Ratio | None:
    """Steps/s under MPS over those of plain sharing."""
    return over(serving_rate(task, gmis), serving_rate(task, gmis, "share"))


def mps_gains() -> dict[str, Ratio | None]:
    """Serving under MPS over plain sharing, by task and GMIs: as few as the paper has, and 8."""
    return {f"{task}_{n}": mps_over_share(task, n) for task in TASKS for n in (2, 8)}


def mps_over_one(task: str, gmis: int) -> Ratio | None:
    """Steps/s of GMIs under MPS over one process, of one call."""
    return over(serving_rate(task, gmis), serving_rate(task, 1))


def _peaks(task: str) -> list[tuple[str, Figure]]:
    """The fastest size of one process and of GMIs under MPS, and their steps/s."""
    if (made_by := _of_peaks().get(task)) is None:
        return []
    sides = _sides([*_cases({task: made_by})])
    best = [max(side, key=lambda case: case["colocated"]) for side in sides]
    return [
        (f"{case['simulators']} x {case['num_envs']:,}", found)
        for case in best
        if (found := _rate(case, made_by))
    ]


def peak_over_peak(task: str) -> Ratio | None:
    """Steps/s of serving in GMIs over one process, each with its best number of environments."""
    (_, one), (_, several) = _peaks(task) or [("", None)] * 2
    return over(several, one)


@table_of_calls(
    "serving-peaks",
    "task | one process x environments | steps/s: | several GMIs | steps/s: | ratio:",
    _of_peaks,
)
def serving_peaks(_: Calls) -> Rows:
    """Each side at its own best number of environments, as the paper's figure 7a."""
    for task in TASKS:
        if peaks := _peaks(task):
            cells = [cell for size, rate in peaks for cell in (size, shown(rate, ",.0f"))]
            yield [f"`{task}`", *cells, shown(peak_over_peak(task))]


def templates_gains() -> list[Ratio]:
    """Steps/s of one GMI for all tasks over one for each, of every case."""
    return [
        Ratio(case["colocated"] / case["dedicated"], evidence)
        for case, evidence in _of_both_templates()
    ]


def of_communication() -> list[Ratio]:
    """Time to move experience between GMIs over that of simulator and agent, of every case."""
    return [
        Ratio(case["com_s"] / (case["simulator_s"] + case["agent_s"]), evidence)
        for case, evidence in _of_both_templates()
    ]


def _of_both_templates() -> Iterator[tuple[Case, Evidence]]:
    calls = _of_templates()
    for case in _cases(calls):
        if "simulator_s" in case:
            call, path = calls[case["task"]]
            sources = frozenset([source(path.stem, call)])
            yield case, Evidence(min(map(len, case["runs"].values())), sources)


@table_of_calls(
    "backends",
    "task | MJX | GMIs x environments | `mps`, steps/s: | `share`, steps/s: | ratio: | "
    "over one process under MPS:",
    _of_backends,
)
def backends(_: Calls) -> Rows:
    """MPS against plain sharing."""
    for task in TASKS:
        for gmis in GMIS:
            pair = [serving_rate(task, gmis, backend) for backend in ("mps", "share")]
            if all(pair):
                impl = (_case(task, gmis, "share") or {}).get("impl") or ""
                rates = (shown(one, ",.0f") for one in pair)
                gains = shown(over(*pair)), shown(mps_over_one(task, gmis))
                size = f"{gmis} x {8192 // gmis:,}"
                yield [f"`{task}`", impl, size, *rates, *gains]


SERVING_HEAD = (
    "GMIs that simulate | `tcg`, steps/s: | `tdg`, steps/s: | T_s, ms: | T_a, ms: | COM, ms: "
    "| model: | measured:"
)


@table_of_calls("serving-templates", SERVING_HEAD, _of_templates, lambda task: f"`{task}`")
def serving_templates(calls: Calls) -> Rows:
    """Simulator and agent in one GMI against apart, with the paper's model."""
    return [serving_row(case) for case in _cases(calls) if "simulator_s" in case]


def serving_row(case: Case) -> list[str]:
    """A case of serving, of which one template may not have been measured."""
    tcg, tdg = case.get("colocated"), case.get("dedicated")
    times_s = [case.get(key) for key in ("simulator_s", "agent_s", "com_s")]
    return [
        *(case["name"], shown(tcg, ",.0f"), shown(tdg, ",.0f")),
        *(shown(None if one is None else 1e3 * one) for one in times_s),
        shown(predicted_gain(case) if "com_s" in case else None),
        shown(tcg / tdg if tcg and tdg else None),
    ]


def predicted_gain(case: Case) -> float:
    """Throughput of co-located over dedicated GMIs by equation 2, with the paper's R and alpha."""
    simulator, agent = Task(case["simulator_s"], 10.0), Task(case["agent_s"], 1.0)
    return serving_gain(simulator, agent, 0.2, case["com_s"])

"""The tables of training in which some GMIs act and others learn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.cases import SUITES, Case
from benchmarks.evaluation.evidence import Ratio
from benchmarks.evaluation.figures import (
    TRAINING,
    WHOLE_RUN,
    Figure,
    figure,
    over,
    rate,
    ratio,
    ratio_at,
    results_of,
    shown,
    sources_of,
    summaries,
)
from benchmarks.evaluation.learning_tables import NEARLY, reached
from benchmarks.evaluation.paper import CHANNELS
from benchmarks.evaluation.writer import Calls, Rows, newest, table, table_of_calls
from benchmarks.records import Call

LONG = "async-long"
KEYS = ("pps", "ttop", WHOLE_RUN)
SECONDS = "wall_s"
"""Of a whole command, from its start to its end."""
RATES, GAINS = ("rounds", "updates"), ("held", "rounds_free", "updates_free")

FOUR, LEARNERS = "async-4gpu", "sac-2gpu"


@table(
    "async",
    "ant | PPS: | TTOP: | steps/s of the whole run: | ratios: | the paper's: | return at the end:",
    FOUR,
)
def asynchronous() -> Rows:
    """Agents and trainers on four GPUs: medians of report lines, and whole runs."""
    base = SUITES[FOUR][0].name
    for case in (one.name for one in SUITES[FOUR]):
        cells = [shown(rate(FOUR, case, key), ",.0f") for key in KEYS]
        gains = [shown(ratio(FOUR, case, base, key)) for key in KEYS]
        paper = "1.88 PPS, 1.65 TTOP"  # Its mean over two and four GPUs.
        if case == base:
            gains, paper = ["1"] * 3, "1"
        final = shown(rate(FOUR, case, "final_return"), ",.0f")
        yield [case, *cells, " / ".join(gains), paper, final]


@table(
    LEARNERS,
    "ant, SAC | PPS: | over one GPU: | TTOP, transitions drawn a second: | over one GPU: "
    "| seconds to nine tenths of one GPU's return:",
    LEARNERS,
)
def several_learners() -> Rows:
    """Learners that act, each with its own replay, and average their gradients."""
    base = SUITES[LEARNERS][0].name
    final = rate(LEARNERS, base, "final_return")
    for case in (one.name for one in SUITES[LEARNERS]):
        seconds = reached(NEARLY * final.median, LEARNERS, case) if final else None
        acting, drawn = rate(LEARNERS, case), _drawn(case)
        yield [
            *(case, shown(acting, ",.0f"), shown(over(acting, rate(LEARNERS, base)))),
            *(shown(drawn, ",.0f"), shown(over(drawn, _drawn(base)))),
            shown(seconds, ".1f"),
        ]


def learners_over_one() -> Ratio | None:
    """Steps/s of two GPUs over one, each transition drawn as often."""
    base, *_, as_often = (one.name for one in SUITES[LEARNERS])
    return ratio(LEARNERS, as_often, base)


def _drawn(case: str) -> Figure | None:
    """Transitions that all learners of a case draw from their replays in a second."""
    config = results_of(LEARNERS).get("cases", {}).get(case, {}).get("config")
    if config is None:
        return None
    algo = config["algo"]
    for_each_step = algo["updates_per_step"] * algo["batch_size"] / config["num_envs"]
    drawn = [for_each_step * one[TRAINING] for one in summaries(LEARNERS, case)]
    return figure(drawn, *sources_of(LEARNERS))


@table(
    "async-long",
    "ant, 100M steps | steps/s: | over synchronous: | steps/s of the whole run: "
    "| over synchronous: | return at the end:",
    LONG,
)
def asynchronous_long() -> Rows:
    """Runs of 100M steps, against synchronous training on as many GPUs."""
    for case in SUITES[LONG]:
        keys = (TRAINING, WHOLE_RUN, "final_return")
        cells = [shown(rate(LONG, case.name, key), ",.0f") for key in keys]
        gains = [shown(over_synchronous(case, key)) for key in keys[:2]]
        yield [case.name, cells[0], gains[0], cells[1], gains[1], cells[2]]


def over_synchronous(case: Case, key: str = TRAINING) -> Ratio | None:
    """A case of `LONG` over synchronous training on as many GPUs; above 1 it is faster."""
    base = next(one.name for one in SUITES[LONG] if one.gpus == case.gpus)
    faster, slower = (base, case.name) if key == SECONDS else (case.name, base)
    return ratio(LONG, faster, slower, key)


def asynchronous_gains(gpus: int, key: str) -> list[Ratio | None]:
    """Of every asynchronous case of `LONG` on so many GPUs."""
    cases = [one for one in SUITES[LONG] if one.gpus == gpus and "synchronous" not in one.name]
    return [over_synchronous(case, key) for case in cases]


@table(
    "channels",
    "task | GPUs: | PPS: | TTOP: | whole run: | the paper's PPS / TTOP:",
    "async-channels",
)
def channels() -> Rows:
    """Channels against tensor by tensor, in jobs."""
    for task, gpus in CHANNELS:
        names = f"{task} multi", f"{task} uni"
        found = [ratio("async-channels", *names, key) if gpus == 2 else None for key in KEYS]
        pairs = CHANNELS.get((task, gpus), ())
        paper = " / ".join(f"{multi / uni:.2f}" for uni, multi in pairs)
        yield [f"`{task}`", str(gpus), *map(shown, found), paper]


def beside_a_learner() -> list[Ratio | None]:
    """Steps/s of SAC in an agent and a learner over one program, two updates for each step."""
    ways = (f"2 updates, {way}/{TRAINING}" for way in ("agent + learner", "one program"))
    reference = " over ".join(ways)
    return [ratio_at(f"sac-{task}.json#{reference}") for task in ("ant", "humanoid", "go1")]


def _task_and_size(call: Call) -> tuple[str, str | None, tuple[int, ...]]:
    assert call.settings is not None
    overrides = call.settings["overrides"]
    task = next(one.removeprefix("env=") for one in overrides if one.startswith("env="))
    resolved = call.results["resolved"]
    keys = ("num_envs", "updates_per_step", "batch_size")
    return task, call.device, tuple(resolved[key] for key in keys)


@table_of_calls(
    "off-policy",
    "task | environments, updates, batch | one program: rounds/s: | updates/s: | "
    "two GMIs, ratio held: | as fast as each can: rounds: | updates: | "
    "over one program at their ratio, computed:",
    lambda: newest("off-policy-*-nvidia-*.json", _task_and_size),
    is_brief=True,
)
def off_policy(calls: Calls) -> Rows:
    """What two GMIs of one GPU gain over one program, where one acts and the other learns."""
    for (task, _, size), (call, _) in sorted(calls.items()):
        repeats = [one for one in call.results["repeats"] if one["backend"] == "mps"]
        found = [
            *((".0f", [one["in_turn"][f"{what}_per_s"] for one in repeats]) for what in RATES),
            *((".2f", [one["gain"][key] for one in repeats]) for key in GAINS),
            (".2f", [over_the_same_ratio(one) for one in repeats]),
        ]
        cells = (shown(figure(values), form) for form, values in found)
        yield [f"`{task}`", ", ".join(f"{number:,}" for number in size), *cells]


def over_the_same_ratio(repeat: Mapping[str, Any]) -> float:
    """Two GMIs that wait for nobody, over one program with their ratio of updates to rounds.

    That program is not run: it would take the seconds of a round and those of its updates, each as
    measured alone in one program.
    """
    two, one = repeat["two_gmis"], repeat["in_turn"]
    updates = two["free_updates_per_s"] / two["free_rounds_per_s"]
    round_s = 1 / one["acting_alone_rounds_per_s"]
    return two["free_rounds_per_s"] * (round_s + updates / one["learning_alone_updates_per_s"])

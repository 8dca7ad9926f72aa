"""How benchmarks run their commands, what each of them asks for, and what it keeps."""

from __future__ import annotations

import argparse
import importlib
import json
import re
import shlex
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from supervision import MPS, machine

from benchmarks import records, runner
from benchmarks.cases import SUITES
from benchmarks.free_gpus import FreeGpus, on_free_gpus
from benchmarks.records import read_calls
from benchmarks.runner import exit_code, failure_of, in_turn, start, wait_until
from gmijax.cli.compose import compose
from gmijax.errors import ConfigError
from gmijax.supervise.job_kinds import training_plan


@pytest.fixture(autouse=True)
def handlers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signals stay those of the tests."""
    monkeypatch.setattr(runner.signal, "signal", lambda *_: None)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What a benchmark takes for the time, in seconds."""
    now_s = [0.0]
    monkeypatch.setattr(runner.time, "monotonic", lambda: now_s[0])
    return now_s


def turns(clock: list[float], took_s: dict[str, float], *given: Any, **more: Any) -> list[str]:
    found = []
    for repeat, case in in_turn(list(took_s), *given, **more):
        found.append(f"{case}{repeat}")
        clock[0] += took_s[case]
    return found


def test_every_case_comes_once_before_one_comes_twice(clock: list[float]):
    assert turns(clock, {"a": 1.0, "b": 1.0}, 2) == ["a0", "b0", "a1", "b1"]


def test_what_would_not_end_in_time_is_left_out(clock: list[float]):
    # Before the deadline is the time to stop: 20 s are left for the second turn.
    deadline_s = 90.0 + runner.STOP_S
    assert turns(clock, {"a": 60.0, "b": 10.0}, 3, deadline_s) == ["a0", "b0", "b1"]


def test_a_case_may_be_expected_to_take_as_long_as_any_before(clock: list[float]):
    took_s = {"a": 60.0, "b": 10.0, "c": 10.0}
    given = took_s, 1, 80.0 + runner.STOP_S
    assert turns(clock, *given, like=lambda _: "any") == ["a0"]
    clock[0] = 0.0
    assert turns(clock, *given) == ["a0", "b0", "c0"]


def test_a_command_is_asked_to_end_in_time():
    processes = [start(["sleep", "60"], {}), start(["true"], {})]
    processes[1].wait()  # By itself.
    deadline_s = time.monotonic() + runner.STOP_S + 0.1
    assert wait_until(deadline_s, *processes) == [-2, 0]


def test_a_failure_is_the_last_line_of_stderr():
    assert failure_of(["true"]) is None
    assert failure_of(["false"]) == "exit code 1"
    assert failure_of(["sh", "-c", "echo one >&2; echo two >&2; exit 3"]) == "two"
    assert failure_of(["sh", "-c", "test $PWD = / || exit 1"], Path("/")) is None


def test_free_gpus_are_given_back():
    free = FreeGpus(3)
    with free.taken(2) as first, free.taken() as second:
        assert (first, second) == ((0, 1), (2,))
    with free.taken(3) as all_of_them:
        assert all_of_them == (0, 1, 2)


def test_who_needs_several_gpus_is_not_passed_by_who_needs_one():
    free, order = FreeGpus(2), []

    def take(count: int) -> None:
        with free.taken(count):
            order.append(count)

    threads = [threading.Thread(target=take, args=(count,)) for count in (2, 1)]
    with free.taken():
        for number, thread in enumerate(threads, 1):
            thread.start()
            while len(free._waiting) < number:
                time.sleep(0.001)
        assert order == []  # One GPU is free, and it is not that thread's turn.
    for thread in threads:
        thread.join()
    assert order == [2, 1]


def test_turns_get_as_many_gpus_as_they_need_or_none():
    def run(turn: int, gpus: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
        if turn > 2:
            raise ConfigError("needs too many")
        return turn, gpus

    assert on_free_gpus(None, [1, 2], lambda turn: turn, run) == [(1, ()), (2, ())]
    assert on_free_gpus(2, [2, 2], lambda turn: turn, run) == [(2, (0, 1))] * 2
    with pytest.raises(ConfigError, match="needs too many"):
        on_free_gpus(3, [1, 3], lambda turn: turn, run)


@pytest.mark.parametrize(
    ("error", "code"), [(ConfigError("no such task"), 2), (KeyboardInterrupt(), 130)]
)
def test_bad_input_and_an_interruption_are_exit_codes(
    error: BaseException, code: int, capsys: pytest.CaptureFixture[str]
):
    def main() -> int:
        raise error

    assert exit_code(main) == code
    assert capsys.readouterr().err == ("no such task\n" if code == 2 else "")


METRICS = [
    {"env_steps": 64 * n, "wall_s": 0.5 * n, "return": 1.0, "reward_per_step": 1.0}
    | {"diverged_steps": 0.0, "time/rollout_s": 0.1 * n}
    for n in range(1, 6)
]
RATES = dict.fromkeys(("step_per_s_sim", "step_per_s_inference", "step_per_s_train"), 2.0)
SUMMARY = {**RATES, "final_return": 1.0, "device": {"peak_memory_mib": 1}, "impl": "jax"}
STAGES = {name: {"p50": value} for name, value in (("simulate", 3), ("infer", 1), ("exchange", 2))}
JOB: dict[str, Any] = {
    **{"state": "completed", "wall_s": 5.0, "value": 1.0, "start_s": 0.0, "first_update_s": 1.0},
    **{"overrides": {"seed": 0}, "env_steps": 10, "env_steps_per_s": 5.0},
}
REPORT: dict[str, Any] = {
    **{"status": "completed", "trainings_per_hour": 100.0, "wall_s": 30.0, "at_once": []},
    "sweep": {"jobs_per_gpu": 1},
}


class Commands:
    """Takes the place of commands: keeps them, and leaves in their folders what they would."""

    def __init__(self, *failing: int) -> None:
        self.made: list[list[str]] = []
        self.failing = failing

    def run(self, command: Sequence[str], *given: Any) -> int:
        (place,) = (word for word in command if word.startswith(("run.dir=", "run.name=")))
        key, _, name = place.partition("=")
        folder = Path(name) if key == "run.dir" else given[0] / "runs" / name
        scratch = (place, f"search.store={folder.parent}")
        self.made.append([word for word in command if word not in scratch][1:])
        if len(self.made) - 1 in self.failing:
            raise KeyboardInterrupt
        job = folder / "000"
        for run in (folder, job):
            run.mkdir(parents=True, exist_ok=True)
            text = "".join(f"{json.dumps(line)}\n" for line in METRICS)
            (run / "metrics.jsonl").write_text(text)
        report = {**REPORT, "jobs": [{**JOB, "run_dir": str(job)}]}
        for name, content in (
            ("config", {"seed": len(self.made)}),
            ("summary", {**SUMMARY, "step_per_s_inference": 2.0, "stages_ms": STAGES}),
            ("sweep", report),
            ("pack", report),
            ("search", {"env": "ant", "best": {"num_envs": 64}, "wall_s": 5.0}),
        ):
            (folder / f"{name}.json").write_text(json.dumps(content))
        return 0

    def failure_of(self, command: Sequence[str], folder: Path | None = None, *_: Any) -> None:
        self.run(command, folder)


SWEEP = ["-m", "gmijax.sweep"]
BENCHMARKS: dict[str, tuple[list[str], str, list[list[str]]]] = {
    "run": (
        ["lgr-ant", "--only", "2G2T mpr", "--repeats", "1"],
        "lgr-ant",
        [
            [
                *("-m", "gmijax.train", "env=ant", "num_envs=2048", "num_timesteps=3145728"),
                *("plan.gpus=2", "plan.gmis_per_gpu=2", "plan.backend=mps", "reduce.strategy=mpr"),
                "run.checkpoint_every=0",
            ]
        ],
    ),
    "seeds": (
        ["env=ant", "--seeds", "2", "--row", "a", "--row", "b: algo.discounting=0.9"],
        "seeds-ant-cpu",
        [
            [*SWEEP, "env=ant", *own, "seed=range(2)", "sweep.jobs_per_gpu=8", "sweep.pack=gmi"]
            for own in ((), ("algo.discounting=0.9",))
        ],
    ),
    "sweeps": (
        ["env=ant", "--jobs", "4", "--at-once", "2", "--packed", "4", "--repeats", "1", "--warm"],
        "sweeps-cpu",
        [
            [*SWEEP, "env=ant", *own, "sweep.gpus=1"]
            for own in (
                ("num_timesteps=1", "seed=range(1)", "sweep.jobs_per_gpu=1", "plan.backend=auto"),
                ("num_timesteps=1", "seed=range(4)", "sweep.jobs_per_gpu=4", "sweep.pack=vmap"),
                ("seed=range(4)", "sweep.jobs_per_gpu=2", "plan.backend=auto"),
                ("seed=range(4)", "sweep.jobs_per_gpu=4", "sweep.pack=vmap"),
            )
        ],
    ),
    "packs": (
        ["a", "--at-once", "2", "--share", "--many", "1/2", "--repeats", "1", "--", "train", "-x"],
        "packs-cpu",
        [
            [
                *("-m", "gmijax.pack", "pack.copies=2", f"pack.jobs_per_gpu={count}"),
                *("pack.backend=auto", "--", "train", "-x"),
            ]
            for count in (2, 1)
        ],
    ),
    "searches": (
        ["--tasks", "ant", "--", "search.budget_s=60"],
        "searches-cpu",
        [["-m", "gmijax.search", "env=ant", "search.budget_s=60"]],
    ),
    "serving": (
        ["--tasks", "ant", "--simulators", "2", "--templates", "tdg"],
        "serving-cpu",
        [
            [
                *("-m", "gmijax.serve", "env=ant", "policy=random", "num_envs=4096"),
                *("num_timesteps=5242880", "unroll_length=32", "plan.gmis_per_gpu=3"),
                *("plan.template=tdg", "plan.backend=auto", "physics.impl=auto"),
            ]
        ],
    ),
}
"""Arguments of a benchmark, its file, and its commands but for the folder of their results."""


def run_benchmark(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, commands: Commands, *more: str
) -> int:
    module = importlib.import_module(f"benchmarks.{name}")
    for function, fake in (("run_command", commands.run), ("failure_of", commands.failure_of)):
        for user in (runner, module):
            if hasattr(user, function):
                monkeypatch.setattr(user, function, fake)
    for user in (records, module):
        if hasattr(user, "detect_machine"):
            monkeypatch.setattr(user, "detect_machine", lambda: machine(0))
    arguments = BENCHMARKS[name][0]
    monkeypatch.setattr(sys, "argv", [name, "--out", str(folder), *more, *arguments])
    return exit_code(module.main)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_runs_its_commands_and_adds_a_call(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    _, file, expected = BENCHMARKS[name]
    for _ in range(2):
        commands = Commands()
        assert run_benchmark(name, tmp_path, monkeypatch, commands) == 0
        assert commands.made == expected
    first, second = read_calls(tmp_path / f"{file}.json")
    assert first.device == "cpu"
    assert first.settings == second.settings
    assert first.results.keys() == second.results.keys()


def test_seeds_without_a_row_are_of_one_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    arguments, file, commands = ["env=ant", "--seeds", "2"], *BENCHMARKS["seeds"][1:]
    monkeypatch.setitem(BENCHMARKS, "seeds", (arguments, file, commands))
    made = Commands()
    assert run_benchmark("seeds", tmp_path, monkeypatch, made) == 0
    assert made.made == commands[:1]
    (call,) = read_calls(tmp_path / f"{file}.json")
    assert [row["row"] for row in call.results["rows"]] == ["baseline"]


@pytest.mark.parametrize("name", ["seeds", "packs"])
def test_what_is_through_is_kept_when_a_benchmark_is_interrupted(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert run_benchmark(name, tmp_path, monkeypatch, Commands(1)) == 130
    (call,) = read_calls(tmp_path / f"{BENCHMARKS[name][1]}.json")
    assert len(call.results["rows"]) == 1


def test_only_what_has_not_succeeded_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commands, path = Commands(), tmp_path / "lgr-ant.json"

    def resume() -> int:
        given = ("--runs", str(tmp_path / "runs"), "--resume")
        assert run_benchmark("run", tmp_path, monkeypatch, commands, *given) == 0
        return len(commands.made)

    assert (resume(), resume()) == (1, 1)
    data = json.loads(path.read_text())
    (case,) = data["calls"][0]["results"]["cases"].values()
    del case["runs"][0]["summary"]
    path.write_text(json.dumps(data))
    assert resume() == 2


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["reward-ant", "--only", "none"], "--only 'none': no case of these suites has that in"),
        (["async-channels", "--gpus", "1"], "--gpus 1: every case of these suites needs more"),
    ],
)
def test_a_suite_without_a_case_to_run_is_refused(
    arguments: list[str],
    error: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setattr(sys, "argv", ["run", "--out", str(tmp_path), *arguments])
    assert exit_code(importlib.import_module("benchmarks.run").main) == 2
    assert capsys.readouterr().err.startswith(error)


@pytest.mark.parametrize("suite", SUITES)
def test_every_case_has_a_plan(suite: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gmijax.partition.reduction.is_installed", lambda *_: True)
    for case in SUITES[suite]:
        gpus = f"plan.gpus=[{','.join(map(str, range(case.gpus)))}]"  # As `--gpus` has it.
        for more in ((), (gpus,)):
            config = compose(*(text.format(run=0) for text in case.overrides), *more)
            plan = training_plan(config, machine(case.gpus, mps_control=MPS))
            assert plan.layout.num_gpus == case.gpus


def test_what_would_not_end_before_the_deadline_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    commands = Commands()
    assert run_benchmark("run", tmp_path, monkeypatch, commands, "--deadline-s", "1") == 1
    assert commands.made == []
    assert capsys.readouterr().err == "1 of 1 runs failed or had no time: see --resume\n"


class Taken(Exception):
    """Its options were taken: it would begin to measure."""


def written_commands() -> list[str]:
    """Of the plan and the documents, what stands behind `python -m benchmarks.`."""
    root = Path(runner.__file__).parents[1]
    found = []
    for path in (root / "benchmarks" / "plan.md", *sorted((root / "docs").rglob("*.md"))):
        text = path.read_text().replace("\\\n", " ")
        found += re.findall(r"(?:^|`)python -m benchmarks\.([^`\n]+)", text, re.MULTILINE)
    return [one for one in dict.fromkeys(found) if " " in one]


@pytest.mark.parametrize("command", written_commands())
def test_commands_that_are_written_down_are_taken(command: str, monkeypatch: pytest.MonkeyPatch):
    for name in ("parse_args", "parse_intermixed_args"):
        parse = getattr(argparse.ArgumentParser, name)

        def parsed(self: Any, *given: Any, parse: Any = parse, **named: Any) -> None:
            parse(self, *given, **named)
            raise Taken

        monkeypatch.setattr(argparse.ArgumentParser, name, parsed)
    module, *words = shlex.split(command)
    if module == "peers":
        module = "peers.__main__"
    monkeypatch.setattr(sys, "argv", [module, *words])
    with pytest.raises(Taken):
        importlib.import_module(f"benchmarks.{module}").main()

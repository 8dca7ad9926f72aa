"""Searches with store, budget and console, over profiles that are a formula."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from supervision import machine

from gmijax.autotune import tuner
from gmijax.autotune.grid import Measured, NotRunnable, Point
from gmijax.autotune.profile import ProfileLate
from gmijax.autotune.report import draw
from gmijax.autotune.tuner import Search, SearchResult, with_auto_decided
from gmijax.autotune.workloads import SynchronousWorkload, Workload
from gmijax.cli.compose import compose
from gmijax.config import TrainConfig
from gmijax.control import searching
from gmijax.control.console import Show, open_console
from gmijax.errors import ConfigError, GmijaxError, JobInterrupted
from gmijax.machine.host_limits import HostLimits
from gmijax.machine.snapshot import Machine
from gmijax.search import main as search_command

Answer = Callable[[Point], Measured | NotRunnable]
GRID = ("search.gmis_per_gpu=[4,2,1]", "search.num_envs=[64,128]")
MPS = Path("/usr/bin/nvidia-cuda-mps-control")


class Profiles:
    """In place of `gmijax.autotune.profile.profile`: answers with a formula and counts."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.asked: list[Point] = []

    def __call__(
        self, workload: Workload[Any], point: Point, *_: Any, **__: Any
    ) -> Measured | NotRunnable:
        assert workload.kind.module == "gmijax.workers.training_worker"
        self.asked.append(point)
        return self.answer(point)


def scaling(point: Point) -> Measured:
    """Twice the throughput with twice the environments; GMIs of a GPU cost each other 10 %."""
    contention = 0.9 if point.gmis_per_gpu > 1 else 1.0
    return Measured(contention * 1000.0 * point.num_envs, 100.0 + point.num_envs, 0.1)


Use = Callable[[Answer], Profiles]


@pytest.fixture
def profiles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Use:
    monkeypatch.chdir(tmp_path)

    def use(answer: Answer) -> Profiles:
        used = Profiles(answer)
        monkeypatch.setattr(tuner, "profile", used)
        monkeypatch.setattr(tuner, "draw", lambda *_: None)  # It takes a second.
        return used

    return use


@functools.cache
def wanted(*overrides: str) -> TrainConfig:
    return compose(*GRID, "search.store=store", *overrides, command="search")


def found(*overrides: str, here: Machine | None = None) -> tuple[SearchResult, str]:
    output = io.StringIO()
    console = Console(file=output, width=400, markup=False)
    result = Search(SynchronousWorkload(wanted(*overrides)), here or machine(0), console).result()
    return result, output.getvalue()


def test_a_second_search_profiles_nothing(profiles: Use, monkeypatch: pytest.MonkeyPatch):
    first = profiles(scaling)
    monkeypatch.setattr(tuner, "draw", draw)
    result, output = found()
    assert (result.gmis_per_gpu, result.num_envs, result.impl) == (4, 128, "jax")
    assert len(first.asked) == 4
    assert result.run_dir
    assert result.reason in output
    assert "3.60 times the best with one GMI" in result.reason
    report = json.loads((result.run_dir / "search.json").read_text())
    assert report["best"] == {
        "gmis_per_gpu": 4,
        "num_envs": 128,
        "impl": "jax",
        "projected": pytest.approx(4 * 0.9 * 128_000),
    }
    assert (report["complete"], report["num_profiled"]) == (True, 4)
    assert (result.run_dir / "search.png").stat().st_size > 1000
    compiles = "every profile is a short job of its own, which compiles its programs first; "
    assert output.count(compiles) == 1
    again = profiles(scaling)
    second, output = found()
    assert (again.asked, output.count(compiles)) == ([], 0)
    assert second[1:5] == result[1:5]
    assert second.run_dir is None


def test_an_interrupted_search_goes_on_where_it_was(profiles: Use):
    def interrupted(point: Point) -> Measured:
        if point == Point(2, 128, "jax"):
            raise JobInterrupted("stopped")
        return scaling(point)

    first = profiles(interrupted)
    with pytest.raises(JobInterrupted) as stopped:
        found()
    assert "continues from" in stopped.value.__notes__[0]
    rest = profiles(scaling)
    result, _ = found()
    assert rest.asked[0] == first.asked[-1]
    assert len(first.asked) - 1 + len(rest.asked) == 4
    assert result.num_envs == 128


def test_what_cannot_run_is_reported_and_remembered(profiles: Use):
    reason = "cannot run on layout [[0,1]]: see [/tmp/x]"  # It may look like markup.

    def small(point: Point) -> Measured | NotRunnable:
        return NotRunnable(reason) if point.gmis_per_gpu == 4 else scaling(point)

    profiles(small)
    result, output = found()
    assert result.gmis_per_gpu == 2
    assert f"4 x 128, jax: not runnable: {reason}" in output
    assert output.count(reason) == 2  # When it is profiled, and in the table.
    assert profiles(scaling).asked == []
    assert found()[0].gmis_per_gpu == 2


def test_points_for_which_the_host_is_too_small_are_reported_and_not_started(
    profiles: Use,
):
    few = machine(0, host=HostLimits(memory_mib=1500))
    asked = profiles(scaling)
    result, output = found(here=few)
    assert result.gmis_per_gpu == 2
    assert all(point.gmis_per_gpu < 4 for point in asked.asked)
    assert "4 x 128, jax: not runnable: plan.gmis_per_gpu=4: 4 GMIs on this" in output
    # With more room they are measured: they were not remembered as what cannot run.
    again = profiles(scaling)
    assert found()[0].gmis_per_gpu == 4
    assert {point.gmis_per_gpu for point in again.asked} == {4}
    with pytest.raises(
        ConfigError, match=r"^plan\.gmis_per_gpu=64: 64 GMIs .*; allowed: at most 2$"
    ):
        found("plan.gmis_per_gpu=64", here=few)


def test_a_profile_that_hangs_cannot_run(profiles: Use):
    def late(point: Point) -> Measured:
        if point.num_envs == 128:
            raise ProfileLate("did not end within 5 s (GMI 0 compiling)")
        return scaling(point)

    profiles(late)
    result, _ = found("search.budget_s=20")
    assert result.num_envs == 64
    reasons = [point.get("reason") for point in result.report["points"]]
    assert reasons.count("did not end within 5 s (GMI 0 compiling)") == 2
    again = profiles(scaling)
    assert found("search.budget_s=20")[0].num_envs == 64
    assert again.asked == []
    assert found("search.budget_s=30")[0].num_envs == 128  # More time than they had.
    assert {point.num_envs for point in again.asked} == {128}


def test_more_time_is_advised_where_nothing_ended_in_time_and_only_there(profiles: Use):
    def late(point: Point) -> Measured:
        raise ProfileLate(f"{point} is slow")

    profiles(late)
    advice = "; raise search.budget_s, or use smaller sizes in search.num_envs"
    with pytest.raises(
        GmijaxError, match=rf"no point of the search can run; .* is slow{advice} \(logs: "
    ):
        found()
    profiles(lambda point: NotRunnable(f"{point} has no room"))
    with pytest.raises(
        GmijaxError, match=r"no point of the search can run; .* has no room \(logs: "
    ):
        found("search.store=other")


@pytest.mark.parametrize("end", [JobInterrupted("stopped"), None])
@pytest.mark.parametrize("is_first", [True, False])
def test_a_search_without_a_single_profile_leaves_no_folder(
    profiles: Use, end: JobInterrupted | None, is_first: bool
):
    def answer(point: Point) -> Measured | NotRunnable:
        if end is not None and len(asked.asked) == (1 if is_first else 2):
            raise end
        return NotRunnable(f"{point} has no room")

    asked = profiles(answer)
    with pytest.raises(GmijaxError):
        found()
    folders = list(Path("runs").iterdir())
    # With a profile that failed there are its logs.
    assert len(folders) == (0 if end is not None and is_first else 1)


def test_a_profile_cut_off_by_the_budget_is_no_answer(
    profiles: Use, monkeypatch: pytest.MonkeyPatch
):
    clock = [0.0]
    monkeypatch.setattr(tuner, "running_s", lambda: clock[0])

    def slow(point: Point) -> Measured:
        clock[0] += 12.0
        if point != Point(1, 128, "jax"):
            raise ProfileLate("cut off")
        return scaling(point)

    profiles(slow)
    result, _ = found("search.budget_s=20")
    assert (result.gmis_per_gpu, result.num_envs) == (1, 128)
    assert not result.report["complete"]
    assert "the budget ended the search after 1 points" in result.reason
    rest = profiles(scaling)
    found()
    assert rest.asked[0] == Point(4, 128, "jax")


def test_the_order_of_the_paper_goes_through_the_whole_grid(profiles: Use):
    asked = profiles(scaling).asked
    result, _ = found("search.order=as_printed")
    assert [(point.gmis_per_gpu, point.num_envs) for point in asked] == [
        *((4, 64), (4, 128), (2, 64), (2, 128), (1, 64), (1, 128))
    ]
    assert (result.gmis_per_gpu, result.num_envs) == (4, 128)
    with pytest.raises(ConfigError, match=r"^search\.order=as_printed: no point is a candidate"):
        found("search.order=as_printed", "search.num_envs=[64]")


def test_what_is_given_is_not_searched(profiles: Use):
    asked = profiles(scaling).asked
    assert found("plan.gmis_per_gpu=3")[0].gmis_per_gpu == 3
    assert {point.gmis_per_gpu for point in asked} == {3}
    asked = profiles(scaling).asked
    assert found("num_envs=96", "plan.layout=[[0,1],[2]]")[0].gmis_per_gpu == 2
    assert asked == [Point(2, 96, "jax")]


def test_an_answer_of_one_gmi_is_worded_plainly(profiles: Use):
    profiles(lambda point: Measured(1e6 / point.gmis_per_gpu, 100.0 + point.num_envs, 0.1))
    result, _ = found()
    assert (result.gmis_per_gpu, result.num_envs) == (1, 64)
    assert "one GMI is enough here: the best with several, 4 x 128, jax, makes 1.00" in (
        result.reason
    )


def test_a_job_with_too_few_gpus_is_refused_before_anything_is_profiled(
    profiles: Use,
):
    asked = profiles(scaling)
    config = dataclasses.replace(wanted(), plan=dataclasses.replace(wanted().plan, gpus=3))
    with pytest.raises(ConfigError, match=r"plan\.gpus=3: this machine has 2 usable GPUs"):
        with_auto_decided(config, machine(2, mps_control=MPS), Console(quiet=True))
    given = compose("num_envs=64")
    assert with_auto_decided(given, machine(0), Console(quiet=True)) == (given, ())
    assert asked.asked == []


@pytest.mark.parametrize(
    ("overrides", "trainers", "line"),
    [
        (
            ("env=ant", "algo=sac", "search.num_envs=[64]", "run.dir=s", "physics.impl=auto"),
            0,
            "env=ant algo=sac num_envs=64 plan.gmis_per_gpu=4 physics.impl=warp",
        ),
        ((), 0, "env=ball_balance algo=ppo num_envs=64 plan.gmis_per_gpu=4 physics.impl=warp"),
        (
            ("algo=a3c", "search.num_envs=[64]"),
            1,
            "algo=a3c 'search.num_envs=[64]' num_envs=auto plan.gmis_per_gpu=auto",
        ),
    ],
)
def test_a_search_ends_with_the_training_that_follows(
    overrides: tuple[str, ...], trainers: int, line: str
) -> None:
    config = compose(*overrides, "num_envs=auto", command="search")
    found = SearchResult(None, 4, 64, "warp", "", {}, trainers)
    assert searching.following(config, overrides, found) == f"gmijax train {line}"


@pytest.mark.parametrize(("words", "is_named"), [(["num_envs=auto"], True), (["env=ant"], False)])
def test_the_command_names_a_task_that_nobody_chose(
    words: list[str],
    is_named: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def say(_: TrainConfig, *, show: Show, overrides: Sequence[str]) -> None:
        assert list(overrides) == words
        open_console(show=show).print("run folder: x")

    monkeypatch.setattr(searching, "search", say)
    assert search_command(words) == 0
    *first, last = capsys.readouterr().out.splitlines()
    assert last == "run folder: x"
    assert [line.partition(",")[0] for line in first] == ["task: ball_balance"] * is_named

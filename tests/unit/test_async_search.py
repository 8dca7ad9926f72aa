"""The search for asynchronous jobs: what is profiled, what a profile says, what is refused."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from supervision import gpu, machine

from gmijax.autotune import tuner
from gmijax.autotune.async_profile import FEWEST_LINES, ProfileWindow, measured_of, window_start
from gmijax.autotune.async_workload import A3cWorkload, balance, per_gpu, throughput
from gmijax.autotune.grid import Measured, Point
from gmijax.autotune.tuner import with_auto_decided
from gmijax.autotune.workloads import Split, Workload
from gmijax.cli.compose import compose
from gmijax.config import TrainConfig
from gmijax.errors import ConfigError
from gmijax.runs.folder import RunPaths
from gmijax.supervise.job_kinds import training_plan
from gmijax.supervise.watched_gmi import GmiStatus

GRID = (
    *("search.gmis_per_gpu=[2,1]", "search.num_envs=[64,128]"),
    *("algo=a3c", "search.store=store"),
)


@functools.cache
def wanted(*overrides: str) -> TrainConfig:
    return compose(*GRID, *overrides, command="search")


def line(wall_s: float, env_steps: int, **more: float) -> dict[str, float]:
    rates = {"async/pps": 100.0, "async/updates": 2.0}
    times = {"time/update_s": 0.1, "time/receive_s": 0.0, "time/wait_s": 0.0}
    return {
        "wall_s": wall_s,
        "env_steps": env_steps,
        **rates,
        **times,
        **{name.replace("__", "/"): value for name, value in more.items()},
    }


@pytest.mark.parametrize(
    ("lines", "acting", "learning", "learnt"),
    [
        # Two agents waited for 1.2 s of 2 x 2 s: 100 / (1 - 0.3).
        (
            [line(0, 0), line(1, 100, time__wait_s=0.4), line(2, 200, time__wait_s=0.8)],
            *(100.0 / 0.7, 100.0, 50.0),
        ),
        # By batches: 3 of 4 waited 0.2 s, so 0.15 s on average, beside 0.1 s of work.
        (
            [
                line(0, 0),
                line(1, 100, time__receive_s=0.2, async__updates=3.0),
                line(2, 200, time__receive_s=0.0, async__updates=1.0),
            ],
            *(100.0, 100.0 * 0.25 / 0.1, 50.0),
        ),
        # What had waited in the channels was not made twice, so that TTOP was above PPS.
        ([line(0, 0), line(1, 150), line(2, 300)], 100.0, 150.0, 50.0),
        # Agents that only wait have no endless rate.
        ([line(0, 0), line(1, 100, time__wait_s=2.2)], 2000.0, 100.0, 50.0),
    ],
    ids=["agents wait", "trainers wait", "channels were full", "agents only wait"],
)
def test_what_each_side_could_do(lines: list[Any], acting: float, learning: float, learnt: float):
    found = measured_of(lines, num_agents=2, memory_mib=1.0)
    assert found.acting_per_s == pytest.approx(acting)
    assert found.learning_per_s == pytest.approx(learning)
    assert found.env_steps_per_s == pytest.approx(learnt)


def test_rates_are_those_of_the_lines_after_the_first():
    lines = [line(10.0, 5000), line(10.5, 5050), line(11.0, 5100), line(12.0, 5200)]
    measured = measured_of(lines, num_agents=2, memory_mib=7.0)
    assert measured == Measured(50.0, 7.0, 2.0 / 6, 0.0, 100.0, 100.0)


@pytest.mark.parametrize(
    ("updates", "rates", "wanted", "start"),
    [
        ([9.0] * 8, [9.0] * 8, 6, 8 - FEWEST_LINES),
        ([1.0] * 8, [9.0] * 8, 6, 2),
        ([1.0] * 6, [9.0] * 6, 6, None),
        ([0.0] * 50, [9.0] * 50, 6, None),
        # An unroll of many batches: until the next one is sent, agents have no rate.
        ([2.0] * 7, [9.0, 0, 9.0, 0, 0, 0, 0], 2, 2),
        ([2.0] * 5, [9.0, 0, 0, 0, 0], 2, None),
    ],
)
def test_lines_hold_enough_batches_and_something_that_agents_made(
    updates: list[float], rates: list[float], wanted: int, start: int | None
):
    lines = [
        line(i, 0, async__updates=number, async__pps=rate)
        for i, (number, rate) in enumerate(zip(updates, rates, strict=True))
    ]
    assert window_start(lines, wanted) == start


def test_a_profile_is_read_when_channels_had_filled(tmp_path: Path):
    config = wanted()
    run = RunPaths(tmp_path)
    plan = training_plan(compose("algo=a3c", "plan.serving_gmis_per_gpu=2"), machine(0))
    is_enough = ProfileWindow(config, plan, run)
    written: list[str] = []

    def with_lines(number: int) -> None:
        written.extend(json.dumps(line(len(written) + i, 0)) + "\n" for i in range(number))
        run.metrics.write_text("".join(written))

    def gmis(*unrolls: int) -> list[GmiStatus]:
        return [GmiStatus(gmi, "running", n, 1, None) for gmi, n in enumerate(unrolls)]

    with_lines(20)  # One agent still compiles.
    assert not is_enough([*gmis(20, 20), GmiStatus(2, "compiling", 0, 1, None)])
    assert not is_enough(gmis(20, 20, 3))  # Two may wait, one is sent, one is made.
    assert not is_enough(gmis(20, 20, 4))
    with_lines(1)  # It had begun before.
    assert not is_enough(gmis(21, 21, 5))
    with_lines(FEWEST_LINES)
    assert not is_enough(gmis(24, 24, 8))
    with_lines(1)  # The last line is left out when the profile is read.
    assert is_enough(gmis(25, 25, 9))


@pytest.mark.parametrize(
    ("overrides", "layout"),
    [
        ((), "[[0,1,2]]"),
        (("plan.gpus=4",), "[[1,2],[0]]"),
        (("plan.serving_gpus=3", "plan.training_gpus=2"), "[[1,2],[0]]"),
        (("plan.serving_gpus=[0,1]", "plan.training_gpus=[1,0]"), "[[0,1,2]]"),
        (("plan.serving_gpus=[1,2]", "plan.training_gpus=[0]"), "[[0],[1,2]]"),
    ],
)
def test_one_gpu_of_each_kind_is_profiled(overrides: tuple[str, ...], layout: str):
    workload = A3cWorkload(wanted(*overrides))
    plan = workload.plan_at(Point(2, 64, "jax", 1), machine(0))
    assert (str(plan.layout), plan.num_envs_per_gmi) == (layout, 64)
    assert plan.roles.count("trainer") == 1


def test_profiled_are_gpus_of_the_job():
    workload = A3cWorkload(wanted("plan.serving_gpus=[2,3]", "plan.training_gpus=[1]"))
    plan = workload.plan_at(Point(1, 64, "jax", 2), machine(4))
    used = {
        allocation.device: role
        for allocation, role in zip(plan.allocations, plan.roles, strict=True)
    }
    assert used == {gpu(1).uuid: "trainer", gpu(2).uuid: "simulator+agent"}
    assert workload.plan.num_gpus == 3


ONE = Measured(50.0, 100.0, 0.1, 0.0, acting_per_s=100.0, learning_per_s=300.0)
"""Two agents made 100 in all, as they could; the trainer could learn from three times that."""


@pytest.mark.parametrize(
    ("overrides", "projected", "split"),
    [
        ((), 100.0, None),
        (("plan.serving_gpus=[0,1]", "plan.training_gpus=[0,1]"), 200.0, None),
        (("plan.gpus=2",), 100.0, Split(1, 1)),
        (("plan.gpus=4",), 300.0, Split(3, 1)),
        (("plan.gpus=8",), 600.0, Split(6, 2)),
        (("plan.serving_gpus=4", "plan.training_gpus=1"), 300.0, Split(4, 1)),
        (("plan.serving_gpus=1", "plan.training_gpus=4"), 100.0, Split(1, 4)),
    ],
)
def test_the_projection(overrides: tuple[str, ...], projected: float, split: Split | None):
    workload, point = A3cWorkload(wanted(*overrides)), Point(2, 64, "jax", 1)
    assert workload.projected(point, ONE) == pytest.approx(projected)
    assert workload.split(ONE) == split
    # Waits on both sides are in it.
    half = ONE._replace(env_steps_per_s=ONE.env_steps_per_s / 2)
    assert workload.projected(point, half) == pytest.approx(projected / 2)


def test_placements_are_kept_apart_in_the_store():
    def key(*overrides: str) -> dict[str, Any]:
        return A3cWorkload(wanted(*overrides)).store_key(machine(0))

    assert key() != key("plan.gpus=2")
    assert key("plan.gpus=2") == key("plan.serving_gpus=3", "plan.training_gpus=1")
    assert key() == key("plan.gmis_per_gpu=1", "plan.serving_gmis_per_gpu=3")
    assert key() != key("channel.design=uni")


def formula(point: Point) -> Measured:
    """An agent makes 10 a second for an environment; a trainer learns from 4000."""
    acting, learning = 10.0 * point.gmis_per_gpu * point.num_envs, 4000.0 * point.trainers
    memory_mib = 100.0 + point.num_envs
    return Measured(
        min(acting, learning) / point.gmis_per_gpu, memory_mib, 0.1, 0.0, acting, learning
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Point]:
    monkeypatch.chdir(tmp_path)
    points: list[Point] = []

    def profile(workload: Workload[Any], point: Point, *_: Any, **__: Any) -> Measured:
        points.append(point)
        return formula(point)

    monkeypatch.setattr(tuner, "profile", profile)
    monkeypatch.setattr(tuner, "draw", lambda *_: None)
    return points


def decided(*overrides: str) -> tuple[TrainConfig, str, str]:
    output = io.StringIO()
    config, (reason,) = with_auto_decided(
        wanted(*overrides), machine(0), Console(file=output, width=400, markup=False)
    )
    return config, reason, output.getvalue()


def test_a_job_on_one_gpu_gets_numbers_of_gmis(asked: list[Point]):
    config, reason, output = decided()
    assert len(asked) == 3
    plan = config.plan
    assert (plan.gmis_per_gpu, plan.serving_gmis_per_gpu, plan.training_gmis_per_gpu) == (1, 2, 1)
    assert (config.num_envs, plan.serving_gpus, plan.training_gpus) == (128, None, None)
    assert config.physics.impl == "jax"
    assert reason.startswith(
        "2 serving GMIs with 128 environments each and 1 training GMI per GPU, jax: 2,560 env"
    )
    assert "2.00 times the best with one serving GMI, 1 + 1 x 128, jax" in reason
    assert "2 + 1 x 64, jax: 1,280 env steps/s, agents could make 1,280" in output
    training_plan(config, machine(0))  # It can be run.
    asked.clear()
    config, _, _ = decided("plan.training_gmis_per_gpu=2")
    assert {point.trainers for point in asked} == {config.plan.training_gmis_per_gpu} == {2}


def test_a_job_on_several_gpus_gets_their_division_too(asked: list[Point]):
    config, reason, _ = decided("plan.gpus=4")
    # 2 x 128 make 2,560 on a GPU, 4,000 are learnt from: two and two, 5,120.
    assert (config.plan.serving_gpus, config.plan.training_gpus) == (2, 2)
    assert reason.startswith(
        "2 GPUs with 2 serving GMIs of 128 environments each, 2 GPUs with 1 training GMI, jax: "
        "5,120 env steps/s (projected from one GPU of each kind: agents could make 2,560, "
        "trainers learn from 4,000; with so many GPUs agents are the slower side)"
    )
    report = json.loads(next(Path("runs").glob("*/search.json")).read_text())
    best = report["best"]
    assert (best["trainers"], best["serving_gpus"], best["training_gpus"]) == (1, 2, 2)
    assert str(training_plan(config, machine(0)).layout) == "[[2,3],[4,5],[0],[1]]"


def test_what_is_given_is_kept(asked: list[Point]):
    config, _, _ = decided(
        *("plan.serving_gpus=[0,1,2]", "plan.training_gpus=[3]", "plan.gmis_per_gpu=1"),
        *("plan.serving_gmis_per_gpu=3", "plan.training_gmis_per_gpu=2"),
    )
    assert set(asked) == {Point(3, 64, "jax", 2), Point(3, 128, "jax", 2)}
    plan = config.plan
    assert (plan.serving_gmis_per_gpu, plan.training_gmis_per_gpu) == (3, 2)
    assert (plan.serving_gpus, plan.training_gpus) == ((0, 1, 2), (3,))
    asked.clear()
    config, _, _ = decided("num_envs=96")
    assert {point.num_envs for point in asked} == {96}
    assert config.num_envs == 96


def test_the_profile_of_a_trained_job_is_the_job_without_its_end():
    config = wanted("run.checkpoint_every=7", "plan.gpus=4")
    short: Callable[[Point, int], TrainConfig] = A3cWorkload(config).config_at
    profiled = short(Point(2, 128, "jax", 1), 3)
    assert (profiled.num_envs, profiled.run.checkpoint_every) == (128, 0)
    assert profiled.num_timesteps > 10**12
    with pytest.raises(ConfigError, match=r"algo\.num_minibatches=4"):
        short(Point(2, 130, "jax", 1), 3)


def test_no_other_split_is_better():
    for num_gpus in range(2, 10):
        for acting_per_s in (1.0, 2.5, 40.0):
            for learning_per_s in (1.5, 4.0):
                found = balance(num_gpus, acting_per_s, learning_per_s)
                assert sum(found) == num_gpus
                rate = throughput(found, acting_per_s, learning_per_s)
                # No better than what GPUs in any proportion could do.
                assert rate <= num_gpus * per_gpu(acting_per_s, learning_per_s) * (1 + 1e-9)
                for training in range(1, num_gpus):
                    other = Split(num_gpus - training, training)
                    assert throughput(other, acting_per_s, learning_per_s) <= rate
    assert balance(3, 2.0, 2.0) == (2, 1)  # As good as (1, 2), with fewer training GPUs.
    # 3 of 4 GPUs act: 3 x 1 = 1 x 3.
    assert throughput(Split(3, 1), 1.0, 3.0) == 4 * per_gpu(1.0, 3.0) == 3.0
    with pytest.raises(ValueError, match="num_gpus=1"):
        balance(1, 1.0, 1.0)

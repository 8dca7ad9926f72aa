"""Sweeps without processes: lists to jobs, slots, curves, rankings, what is refused."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from supervision import gpu, machine

import gmijax
from gmijax.autotune.grid import Measured, NotRunnable
from gmijax.cli.compose import compose
from gmijax.cli.grid import build_sweep
from gmijax.cli.pack import build_pack
from gmijax.config.schema import to_dict
from gmijax.config.sweep import SweepConfig
from gmijax.control.console import open_console
from gmijax.errors import ConfigError, JobInterrupted
from gmijax.runs.folder import read_json, write_json
from gmijax.runs.held import OpenFolder, is_locked, locked
from gmijax.supervise.failures import may_be_neighbours
from gmijax.supervise.stop_signals import StopSignals
from gmijax.sweeps import curve_window, jobs_per_gpu, runner
from gmijax.sweeps.by_setting import name_of_middle, seed_summary
from gmijax.sweeps.curve_window import CurveWindow
from gmijax.sweeps.host import LocalHost
from gmijax.sweeps.jobs import Job, jobs_of, placed, require_placeable, require_same, state_of
from gmijax.sweeps.jobs_per_gpu import with_jobs_per_gpu
from gmijax.sweeps.objective import require_logged, why_not_comparable, with_objective
from gmijax.sweeps.packs import PackPlanner, most_together, require_packable
from gmijax.sweeps.paths import ENV_PACK_DIR, SweepPaths
from gmijax.sweeps.profile_jobs import profiled_job
from gmijax.sweeps.progress import Progress
from gmijax.sweeps.report import JobsReport, distinguishing_labels, draw_curves, spread, tables
from gmijax.sweeps.slots import Site, Slot, SlotPool, plan_slots
from gmijax.sweeps.words import announce


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ((), [{}]),
        (("seed=1",), [{}]),
        (("seed=0,1",), [{"seed": "0"}, {"seed": "1"}]),
        (("seed=range(2)",), [{"seed": "0"}, {"seed": "1"}]),
        (
            ("env=ant,humanoid", "algo.learning_rate=choice(1e-4,3e-4)"),
            [
                {"env": env, "algo.learning_rate": rate}
                for env in ("ant", "humanoid")
                for rate in ("0.0001", "0.0003")
            ],
        ),
        (("env=glob(a*,exclude=any*)",), [{"env": "ant"}]),
        (
            ("algo.policy_hidden_layer_sizes=[8,8],[4]",),
            [{"algo.policy_hidden_layer_sizes": text} for text in ("[8,8]", "[4]")],
        ),
    ],
)
def test_lists_become_every_combination(
    overrides: tuple[str, ...], expected: list[dict[str, str]]
) -> None:
    assert [dict(job.overrides) for job in build_sweep(overrides).jobs] == expected


def test_jobs_have_the_configuration_of_the_same_single_training() -> None:
    lists = ("env=ant,ball_balance", "seed=0,1", "algo.policy_hidden_layer_sizes=[8,8],[4]")
    weights = ("env=ant", "env.rewards.energy=-0.1,-0.2", "env.settings.death_reward=-1")
    own = ("env=some.py:make", "env.rewards.near=1,2")
    for sweep in (lists, weights, own):
        for job in build_sweep((*sweep, "num_envs=512")).jobs:
            own_overrides = [f"{key}={value}" for key, value in job.overrides.items()]
            fixed = [text for text in sweep if "," not in text]
            assert job.config == compose(*fixed, *own_overrides, "num_envs=512")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("seed=range(3,3)",), "an empty list"),
        (("seed=1,1",), "a value is repeated"),
        (("algo.learning_rate=interval(0,1)",), "an interval has no list of values"),
        (("seed=range(200)", "num_envs=range(1,200)"), "39,800 jobs; at most 10,000"),
        (("sweep.jobs_per_gpu=1,2",), "expected one value"),
        (("run.dir=a,b",), "expected one value"),
        (("sweep.jobs_per_gpu=0",), "must be at least 1"),
        (("sweep.gpus=[]",), "expected a number of GPUs or distinct indices"),
        (("seed=0,1", "algo.learnin_rate=1"), "unknown key algo.learnin_rate"),
        (("seed=0,x",), "seed"),
        (("env=ant,nobody",), "env=nobody: unknown task"),
        (("sweep.sampler=tpe", "seed=0,1"), "needs sweep.trials"),
        (("sweep.trials=3", "seed=0,1"), "sweep.sampler=grid runs all of them"),
        (("sweep.pruner=asha", "seed=0,1"), "not with sweep.sampler=grid"),
        (("sweep.pack=mps", "seed=0,1"), "expected one of gmi, vmap, auto"),
        (("cluster=null", "seed=0,1"), "cluster=null: expected a group of keys"),
        (("++cluster=3", "seed=0,1"), "cluster=3: expected a group of keys"),
        (("~sweep", "seed=0,1"), "missing key sweep"),
        (
            ("sweep.sampler=random", "sweep.trials=3", "seed=interval(0,5)"),
            "expected an integer",
        ),
        (
            ("sweep.pack=vmap", "sweep.sampler=tpe", "sweep.trials=3", "seed=0,1"),
            "only with sweep.sampler=grid",
        ),
        (
            ("sweep.sampler=tpe", "sweep.trials=3", "seed=1"),
            "sweep.sampler=tpe: there is no list or interval to draw from; allowed: grid",
        ),
        (
            ("sweep.sampler=tpe", "sweep.trials=3", "algo.discounting=interval(0.9,2.5)"),
            "algo.discounting=2.5",
        ),
    ],
)
def test_bad_lists_are_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        build_sweep(overrides)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("trials", [1, 3])
def test_configurations_are_nothing_to_draw_from(
    trials: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("gmijax.sweeps.sweep.run_work")  # Nothing is to be started.
    with pytest.raises(ConfigError, match=r"^sweep\.sampler=random: .* allowed: grid$"):
        gmijax.sweep([compose("seed=0"), compose("seed=1")], sampler="random", trials=trials)


def test_configurations_differ_by_what_they_are_named() -> None:
    jobs = jobs_of([compose(f"seed={seed}", f"num_envs={16 * (seed + 1)}") for seed in range(2)])
    assert [dict(job.overrides) for job in jobs] == [
        {"num_envs": "16", "seed": "0"},
        {"num_envs": "32", "seed": "1"},
    ]
    assert jobs[0].label == "num_envs=16 seed=0"
    assert len({job.program for job in jobs}) == 2
    alike = [compose(f"seed={n}", f"algo.learning_rate={n + 1}e-4") for n in range(2)]
    assert len({job.program for job in jobs_of(alike)}) == 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("plan.gpus=[0]", "a sweep chooses the GPUs"),
        ("plan.layout=[[0]]", "plan.layout: a sweep decides it"),
        ("plan.memory_fraction=0.5", "plan.memory_fraction: a sweep decides it"),
        ("plan.gpus=3", "plan.gpus=3: the sweep has 2 GPUs"),
    ],
)
def test_jobs_that_place_themselves_are_refused(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        require_placeable(jobs_of([compose(override)]), 2)


def test_jobs_are_ranked_by_evaluations_if_they_make_some() -> None:
    asked = SweepConfig(objective="eval/return")
    with pytest.raises(ConfigError, match=r"^sweep\.objective=eval/return: needs eval\.every"):
        with_objective(asked, [compose()])
    evaluates = compose("eval.every=100")
    assert with_objective(SweepConfig(), [evaluates, compose()]).objective == "return"
    windowed = SweepConfig(objective="window/return")
    assert with_objective(windowed, [evaluates]).objective == "return"
    sweep = with_objective(SweepConfig(), [evaluates])
    assert sweep == with_objective(asked, [evaluates]) == asked
    [job] = jobs_of([evaluates])
    for steps, more in (
        (50, {}),
        (100, {"eval/return": 2.0}),
        (150, {}),
        (200, {"eval/return": 1.0}),
    ):
        full = {"return": 9.0, "window/return": 9.0, "window/full": 1, "window/episodes": 500}
        job.progress.take({"env_steps": steps, **full, **more}, sweep)
    assert (job.progress.value, job.progress.latest) == (2.0, 1.0)
    assert job.progress.curve == [(100, 2.0), (200, 1.0)]


LINE = dict.fromkeys(
    ("env_steps", "return", "window/return", "reward/near", "metric/distance", "loss/kl")
)
EVALUATED = LINE | {"eval/return": 1.0, "eval/length": 20.0}


@pytest.mark.parametrize(
    ("line", "objective", "message"),
    [
        (LINE, "metric/distnace", r": did you mean metric/distance\?"),
        (LINE, "metric/speed", r"; allowed: metric/distance"),
        (LINE, "loss/entropy_of_policy", r"; allowed: loss/kl"),
        (LINE, "retrun", r": did you mean return\?"),
        (LINE, "speed/x", r"; allowed: env_steps, loss/kl, metric/distance, return, reward/"),
        (EVALUATED, "eval/lenght", r": did you mean eval/length\?"),
    ],
)
def test_an_objective_that_no_line_has_is_refused(
    line: dict[str, Any], objective: str, message: str
) -> None:
    with pytest.raises(
        ConfigError, match=rf"^sweep\.objective={objective}: not in the.*{message}"
    ):
        require_logged(line, objective)


@pytest.mark.parametrize("objective", ["return", "metric/distance", "eval/length", "eval/x"])
def test_an_objective_may_be_null_or_come_with_an_evaluation(objective: str) -> None:
    require_logged(LINE, objective)


@pytest.mark.parametrize(
    ("objective", "overrides", "warns"),
    [
        ("return", "env.rewards.energy=-0.02,-0.1", True),
        ("eval/return", "env.rewards.energy=-0.02,-0.1", True),
        ("metric/speed_m_per_s", "env.rewards.energy=-0.02,-0.1", False),
        ("return", "env.rewards.energy=-0.1", False),
        ("return", "seed=0,1", False),
    ],
)
def test_returns_of_different_rewards_are_warned_of(
    objective: str, overrides: str, warns: bool
) -> None:
    jobs = build_sweep(("env=ant", "eval.every=100", f"sweep.objective={objective}", overrides))
    warning = why_not_comparable(jobs.configs, jobs.settings)
    assert (warning is not None) == warns
    if warning:
        assert warning.startswith(
            f"warning: sweep.objective={objective}: jobs differ in env.rewards"
        )


def test_a_sweep_says_that_its_jobs_compile_first_unless_all_have_run() -> None:
    work = build_sweep(("seed=0,1",))
    (line,) = work.warnings(())
    assert line.startswith("the first job of each task and size compiles its programs, ")
    for job in work.jobs:
        job.progress.state = "completed"
    assert not work.warnings(())


@pytest.mark.parametrize(("num_gpus", "says"), [(0, True), (1, False)])
def test_a_sweep_of_what_is_meant_for_a_gpu_says_so_once(num_gpus: int, says: bool) -> None:
    here = machine(num_gpus)
    sites = [Site(plan_slots(SweepConfig(jobs_per_gpu=1), here, {"auto"}), here)]
    lines = build_sweep(("env=ant", "seed=0,1")).warnings(sites)
    assert sum("are meant for a GPU" in line for line in lines) == says


def gpu_slots(gpus: int, jobs_per_gpu: int) -> SlotPool:
    here = machine(gpus, mps_control=Path("/usr/bin/nvidia-cuda-mps-control"))
    plan = plan_slots(SweepConfig(jobs_per_gpu=jobs_per_gpu), here, {"auto"})
    return SlotPool([Site(plan, here)])


def taken(slots: SlotPool, num_gpus: int = 1, *, alone: bool = False) -> Slot:
    slot = slots.acquire(num_gpus, alone=alone)
    assert slot is not None
    return slot


def test_jobs_go_to_the_gpu_with_most_room_and_large_ones_to_several() -> None:
    slots = gpu_slots(2, 2)
    first, second = taken(slots), taken(slots)
    assert first.backend == "mps"
    assert {first.label, second.label} == {"GPU 0 slot 0", "GPU 1 slot 0"}
    assert len(set(taken(slots, 2).devices)) == 2
    assert slots.acquire(1) is None
    slots.release(first)
    assert slots.acquire(2) is None
    assert slots.acquire(1) == first


def test_a_job_alone_has_all_slots_of_its_gpu() -> None:
    slots = gpu_slots(2, 2)
    _, second = taken(slots), taken(slots)
    assert slots.acquire(1, alone=True) is None
    slots.release(second)
    alone = taken(slots, alone=True)
    assert alone.label == "GPU 1 slot 0 alone"
    assert alone.devices == second.devices
    taken(slots)
    assert slots.acquire(1) is None
    slots.release(alone)
    assert taken(slots) == second


@pytest.mark.parametrize(
    ("reason", "expected"),
    [
        ("exit code 1: JaxRuntimeError: INTERNAL: CUDA_ERROR_ILLEGAL_ADDRESS: an illegal", True),
        ("exit code 1: cannot ask whether it is an MPS client: MPS daemon in /tmp/x: no", True),
        ("ended by SIGABRT: F0000 stream.cc Check failed", True),
        ("exit code 1: NonFiniteError: point, up to env step 64: loss/policy_loss is nan", False),
        ("exit code 1: JaxRuntimeError: RESOURCE_EXHAUSTED: Out of memory", False),
        ("JaxRuntimeError: INTERNAL: CUDA_ERROR_OUT_OF_MEMORY: out of memory", False),
        ("ended by SIGKILL: not killed by gmijax; perhaps the machine ran out of memory", False),
    ],
)
def test_a_fault_of_the_gpu_may_be_a_neighbours(reason: str, expected: bool) -> None:
    assert may_be_neighbours(f"GMI 0 failed: {reason}") == expected


@pytest.mark.parametrize(
    ("overrides", "fraction"),
    [
        ((), 0.2),
        (("plan.gmis_per_gpu=2",), 0.1),
        (("algo=a3c", "plan.serving_gmis_per_gpu=3"), 0.05),
    ],
)
def test_jobs_divide_the_memory_of_a_gpu(
    overrides: tuple[str, ...], fraction: float, tmp_path: Path
) -> None:
    (job,) = jobs_of([compose(*overrides)])
    config = placed(job, SweepPaths(tmp_path).job(7), taken(gpu_slots(1, 4)), "mps")
    assert config.plan.memory_fraction == fraction
    assert config.plan.backend == "mps"
    assert (config.run.dir, config.run.resume) == (str(tmp_path / "007"), "auto")
    assert config.wandb.group == tmp_path.name


def test_jobs_of_one_program_have_the_memory_and_cores_of_their_slots() -> None:
    slots = gpu_slots(2, 4)
    (job,) = jobs_of([compose()])
    three = slots.acquire(1, num_jobs=3)
    assert three is not None
    assert (three.size, three.devices) == (3, (gpu(0).uuid,))
    assert three.memory_fraction(job.config) == 0.6
    assert len(three.cpus) == 3 * len(taken(slots).cpus)
    rest = [slots.acquire(1, num_jobs=8) for _ in range(2)]
    assert [slot.size for slot in rest if slot is not None] == [3, 1]
    assert not slots.num_gpus_with_free_slot()
    slots.release(three)
    again = slots.acquire(1, num_jobs=8)
    assert again is not None
    assert (again.size, again.is_alone) == (3, False)
    slots = gpu_slots(1, 4)
    alone = slots.acquire(1, alone=True, num_jobs=3)
    assert alone is not None
    assert (alone.size, len(alone.kept_idle), alone.is_alone) == (3, 1, True)
    slots.release(alone)
    whole = slots.acquire(1, num_jobs=4)
    assert whole is not None
    assert (whole.is_alone, whole.label) == (True, "GPU 0 slot 0")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("algo=a3c", "algo=a3c"),
        ("plan.gmis_per_gpu=2", "plan.gmis_per_gpu=2"),
        ("plan.gmis_per_gpu=auto", "plan.gmis_per_gpu=auto"),
        ("plan.gpus=2", "plan.gpus=2"),
        ("eval.every=1000", "eval.every"),
        ("num_envs=auto", "num_envs=auto"),
        ("wandb.mode=offline", "wandb.mode=offline"),
        ("env.randomize=on", "env.randomize=on"),
    ],
)
def test_jobs_that_need_processes_of_their_own_are_not_packed(override: str, message: str) -> None:
    jobs = jobs_of([compose("seed=0"), compose("seed=1", override)])
    require_packable(SweepConfig(), jobs)
    require_packable(SweepConfig(pack="auto"), jobs)
    assert most_together(SweepConfig(pack="auto"), jobs[1], jobs) == 1
    require_packable(SweepConfig(pack="vmap"), jobs[:1])
    with pytest.raises(
        ConfigError, match=f"job 1 has {re.escape(message)}, .* allowed: auto, gmi$"
    ):
        require_packable(SweepConfig(pack="vmap"), jobs)


def test_playground_in_warp_is_not_packed() -> None:
    task = ("env=playground", "env.name=CartpoleBalance")
    in_warp, in_jax = (
        jobs_of([compose(*task, impl, f"seed={seed}") for seed in range(2)])
        for impl in ("physics.impl=warp", "physics.impl=jax")
    )
    assert most_together(SweepConfig(pack="auto"), in_warp[0], in_warp) == 1
    assert most_together(SweepConfig(pack="auto"), in_jax[0], in_jax) == 2


@pytest.mark.parametrize(("sampler", "trials", "num"), [("grid", None, 3), ("random", 3, 1)])
def test_jobs_of_a_sampler_are_not_packed(
    sampler: Any, trials: int | None, num: int, tmp_path: Path
) -> None:
    settings = SweepConfig(pack="auto", sampler=sampler, trials=trials)
    jobs = jobs_of([compose(f"algo.learning_rate={rate}") for rate in (1e-4, 3e-4, 1e-3)])
    require_packable(settings, jobs)
    assert most_together(settings, jobs[0], jobs) == num
    # Those of a lost node wait together; a pruner ends each for itself.
    planner = PackPlanner(settings, SweepPaths(tmp_path))
    assert planner.together(jobs[0], jobs, ()) == jobs[:num]


def test_too_many_jobs_for_the_machine_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"sweep\.jobs_per_gpu=2000"):
        gpu_slots(1, 2000)


def lines_of(
    *windows: tuple[float | None, int, bool], key: str = "return"
) -> list[dict[str, Any]]:
    """Lines of metrics with the mean of the long window, its episodes, and whether it is full."""
    return [
        {
            "env_steps": 100 * (number + 1),
            "env_steps_per_s": 5.0,
            key: None if mean is None else -1.0,
            f"window/{key}": mean,
            "window/episodes": episodes,
            "window/full": int(is_full),
        }
        for number, (mean, episodes, is_full) in enumerate(windows)
    ]


PENALTY = ((None, 0, False), (-6.3, 80, False), (-121.0, 130, False), (-137.0, 170, True))


@pytest.mark.parametrize("key", ["return", "metric/energy", "reward/near", "episode_length"])
@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_a_job_is_ranked_by_its_last_full_window(key: str, direction: Any) -> None:
    progress, sweep = Progress(), SweepConfig(objective=key, direction=direction)
    seen = []
    for line in lines_of(*PENALTY, (-140.0, 175, True), key=key):
        progress.take(line, sweep)
        seen.append((progress.value, progress.is_full, progress.episodes))
    assert seen == [
        (None, True, None),
        (-6.3, False, 80),
        (-121.0, False, 130),
        (-137.0, True, 170),
        (-140.0, True, 175),
    ]
    assert progress.curve == [(400, -137.0), (500, -140.0)]
    # Environments that begin anew after a restart: what was measured before is better.
    progress.take(lines_of((-9.0, 120, False), key=key)[0], sweep)
    assert (progress.value, progress.is_full) == (-140.0, True)


def test_what_has_no_window_is_averaged_over_the_last_tenth() -> None:
    progress, sweep = Progress(), SweepConfig(objective="env_steps_per_s")
    for steps in range(1, 101):
        line = {"env_steps": steps, "env_steps_per_s": 1e6 if steps == 3 else float(steps)}
        progress.take(line | {"window/full": 0, "window/episodes": 0}, sweep)
    assert progress.is_full
    assert progress.value == np.mean(range(90, 101))
    nothing = Progress()
    for bad in (None, float("nan"), float("inf"), "1"):
        nothing.take({"env_steps": 1, "env_steps_per_s": bad}, sweep)
    assert nothing.value is None


def test_a_legend_has_what_tells_settings_apart() -> None:
    command = "command=python -m train --env go1 --lr {} --seed {}"
    assert distinguishing_labels([command.format(0.1, 0), command.format(0.3, 0)]) == [
        "0.1",
        "0.3",
    ]
    assert distinguishing_labels(["lr=1 seed=0"]) == ["lr=1 seed=0"]
    assert distinguishing_labels(["lr=1", "lr=1 wd=2"]) == ["lr=1", "wd=2"]
    long = distinguishing_labels([40 * "a=1 "])[0].splitlines()
    assert len(long) == 2
    assert max(map(len, long)) <= 70


def test_commands_of_any_length_are_drawn(tmp_path: Path) -> None:
    """Matplotlib warns, which is an error here, when nothing is left of the picture."""
    jobs: list[Any] = []
    for number in range(30):
        words = " ".join(f"--key-{n} {number}{n}" for n in range(60))
        progress = Progress(curve=[(0, 0.0), (100, float(number))])
        jobs.append(SimpleNamespace(overrides={"command": f"train {words}"}, progress=progress))
    paths = SweepPaths(tmp_path)
    paths.curves.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(jobs, SweepConfig(objective="return"), paths)
    assert paths.curves.stat().st_size > 10_000


@pytest.mark.parametrize(("passed_s", "rate"), [(1e-4, None), (0.1, None), (2.0, 1500.0)])
def test_lines_that_are_read_together_have_no_rate(
    passed_s: float, rate: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress, sweep = Progress(), SweepConfig()
    for now_s, steps in ((10.0, 1000), (10.0 + passed_s, 4000)):
        monkeypatch.setattr("gmijax.sweeps.progress.time.monotonic", lambda now_s=now_s: now_s)
        progress.report({"env_steps": steps}, sweep)
    assert progress.mean_steps_per_s == rate


def test_lines_of_older_versions_do_not_say_that_they_can_be_compared() -> None:
    progress = Progress()
    progress.take({"env_steps": 10, "return": 3.0}, SweepConfig(objective="return"))
    assert (progress.value, progress.is_full, progress.episodes) == (3.0, False, None)


def test_only_a_run_with_all_its_steps_is_complete(tmp_path: Path) -> None:
    run, config = SweepPaths(tmp_path).job(0), compose("num_timesteps=100")
    assert state_of(run, config) == "waiting"
    write_json(run.config, to_dict(config))
    for status, state in (("interrupted", "waiting"), ("completed", "completed")):
        write_json(run.summary, {"status": status, "env_steps": 100})
        assert state_of(run, config) == state
    assert state_of(run, dataclasses.replace(config, num_timesteps=200)) == "waiting"


@pytest.mark.parametrize(
    ("overrides", "change"),
    [
        (("env=ant",), "env.name is 'ant', was 'ball_balance'"),
        (("num_envs=64",), "num_envs is 64, was 512"),
        (("algo.learning_rate=1e-3",), "algo.learning_rate is 0.001"),
        (("env.episode_length=7",), "env.episode_length is 7"),
        (("seed=3",), "seed is 3, was 0"),
    ],
)
def test_a_complete_job_with_other_settings_is_not_compared(
    overrides: tuple[str, ...], change: str, tmp_path: Path
) -> None:
    run = SweepPaths(tmp_path).job(0)
    write_json(run.config, to_dict(compose("num_timesteps=100")))
    write_json(run.summary, {"status": "interrupted", "env_steps": 50})
    for steps in (100, 200):
        wanted = compose(f"num_timesteps={steps}", *overrides)
        require_same(run, wanted)
    write_json(run.summary, {"status": "completed", "env_steps": 100})
    for steps in (100, 200):
        wanted = compose(f"num_timesteps={steps}", *overrides)
        refused = re.escape(f"complete with other settings: {change}")
        with pytest.raises(ConfigError, match=refused):
            require_same(run, wanted)
    require_same(run, compose("run.checkpoint_every=7", "plan.memory_fraction=0.3"))


def test_a_complete_job_of_distillation_has_the_checkpoint_of_its_teacher(tmp_path: Path) -> None:
    run, config = SweepPaths(tmp_path).job(0), compose("algo=distill", "algo.teacher=runs/x")
    saved = to_dict(config)
    saved["algo"]["teacher"] = "/else/runs/x/checkpoints/000000000640"
    write_json(run.config, saved)
    write_json(run.summary, {"status": "completed", "env_steps": config.num_timesteps})
    require_same(run, config)


def test_a_complete_job_with_an_edited_task_is_not_compared(tmp_path: Path) -> None:
    run, config = SweepPaths(tmp_path).job(0), compose()
    env = dataclasses.replace(config.env, suite="custom", name="t.py:make", source_sha256="a")
    config = dataclasses.replace(config, env=env)
    write_json(run.config, to_dict(config))
    write_json(run.summary, {"status": "completed", "env_steps": config.num_timesteps})
    require_same(run, config)
    edited = dataclasses.replace(config, env=dataclasses.replace(env, source_sha256="b"))
    with pytest.raises(ConfigError, match="has changed since the run was started"):
        require_same(run, edited)


def shown_tables(folder: Path, jobs: Sequence[Job], sweep: SweepConfig) -> list[list[list[str]]]:
    """The rows of the tables for people."""
    report = JobsReport(jobs, sweep, dict, SweepPaths(folder), OpenFolder(folder, "x"), 0.0)
    assert report.end("completed") is None
    columns = [table.columns for table in tables(report.data, sweep)]
    return [
        [list(map(str, row)) for row in zip(*(c.cells for c in own), strict=True)]
        for own in columns
    ]


def ended(
    overrides: Sequence[str], windows: Sequence[tuple[float | None, int, bool]]
) -> list[Job]:
    """Jobs of a sweep, each with a line of metrics, or none if the mean is None."""
    sweep = build_sweep(("env=ant", "sweep.objective=return", *overrides))
    for job, window in zip(sweep.jobs, windows, strict=True):
        job.progress.state = "completed"
        if window[0] is not None:
            job.progress.take(lines_of(window)[0], sweep.settings)
    return list(sweep.jobs)


@pytest.mark.parametrize(("direction", "order"), [("maximize", "20413"), ("minimize", "02143")])
def test_the_ranking_has_full_windows_first_and_jobs_without_a_value_below(
    direction: Any, order: str, tmp_path: Path
) -> None:
    windows = [(1.0, 200, True), (-5.0, 12, False), (3.0, 200, True), (None, 0, False)]
    windows.append((9.0, 99, False))
    jobs = ended(("algo.entropy_cost=1,2,3,4,5",), windows)
    sweep = SweepConfig(objective="return", direction=direction)
    [rows] = shown_tables(tmp_path, jobs, sweep)  # One table: no setting has several seeds.
    assert "".join(row[1] for row in rows) == order
    assert [row[0] for row in rows] == ["1", "2", "3", "4", "-"]
    found = {row[1]: row[3] for row in rows}
    assert found["1"] == "-5 (12 episodes, too few to compare)"
    assert (found["2"], found["3"]) == ("3", "-")
    report = read_json(tmp_path / "sweep.json")
    assert report["ranking"] == [int(number) for number in order[:4]]
    assert [job["window_full"] for job in report["jobs"][:3]] == [True, False, True]


def test_what_was_drawn_is_whole_in_80_columns(tmp_path: Path) -> None:
    jobs = ended(("algo.entropy_cost=1,2,3,4",), [(1.0, 12, False)] * 4)
    drawn = ("0.0009847123400129", "2.2204460492503131e-05", "0.00012345678", "1234567890")
    jobs = [
        dataclasses.replace(job, overrides={"algo.learning_rate": value})
        for job, value in zip(jobs, drawn, strict=True)
    ]
    text, sweep = io.StringIO(), SweepConfig(objective="return")
    report = JobsReport(jobs, sweep, dict, SweepPaths(tmp_path), OpenFolder(tmp_path, "x"), 0.0)
    report.end("completed")
    [table] = tables(report.data, sweep)
    Console(file=text, width=80).print(table)
    lines = text.getvalue().splitlines()
    begin, end = lines[0].index("overrides"), lines[0].index("return")
    shown = "".join(line[begin:end].strip() for line in lines[1:])
    values = ("0.0009847", "2.22e-05", "0.00012345678", "1234567890")
    assert shown == "".join(f"algo.learning_rate={value}" for value in values)
    assert report.data["jobs"][0]["overrides"]["algo.learning_rate"] == drawn[0]


def test_drawn_numbers_that_are_alike_in_short_are_whole(tmp_path: Path) -> None:
    jobs = ended(("algo.entropy_cost=1,2",), [(1.0, 200, True)] * 2)
    drawn = ["0.00098471234001", "0.00098471234002"]
    jobs = [
        dataclasses.replace(job, overrides={"algo.learning_rate": value})
        for job, value in zip(jobs, drawn, strict=True)
    ]
    [rows] = shown_tables(tmp_path, jobs, SweepConfig(objective="return"))
    assert [row[2] for row in rows] == [f"algo.learning_rate={value}" for value in drawn]


def test_without_anything_to_rank_by_there_is_one_table_of_what_is_known(tmp_path: Path) -> None:
    jobs = ended(("algo.entropy_cost=1,2", "seed=0,1"), [(None, 0, False)] * 4)
    for job in jobs:
        job.progress.env_steps, job.progress.earlier_s = 0, 61.0
    [rows] = shown_tables(tmp_path, jobs, SweepConfig(objective="return"))
    assert rows[0] == ["0", "algo.entropy_cost=1 seed=0", "1:01", "completed"]


def test_settings_come_first_with_the_interquartile_mean_of_their_seeds(tmp_path: Path) -> None:
    values = (10.0, 11.0, 12.0, 90.0), (20.0, 21.0, 22.0, 23.0), (50.0, 50.0, None, 50.0)
    windows = [(v, 200, own != values[2] or seed) for own in values for seed, v in enumerate(own)]
    rates = "algo.learning_rate=1e-4,2e-4,3e-4"
    jobs = ended((rates, "seed=0,1,2,3"), [(v, n, bool(full)) for v, n, full in windows])
    settings, rows = shown_tables(tmp_path, jobs, SweepConfig(objective="return"))
    assert len(rows) == 12
    assert [row[1:] for row in settings] == [
        ["algo.learning_rate=0.0002", "21.5", "20.75 to 22.25", "4"],
        ["algo.learning_rate=0.0001", "11.5", "10.75 to 31.5", "4"],
        ["algo.learning_rate=0.0003", "50 (too few episodes to compare)", "50 to 50", "3 of 4"],
    ]
    first = read_json(tmp_path / "sweep.json")["settings"][0]
    assert first["overrides"] == {"algo.learning_rate": "0.0002"}
    assert (first["jobs"], first["n"], first["interquartile_mean"]) == ([4, 5, 6, 7], 4, 21.5)
    with (tmp_path / "settings.csv").open() as file:
        table = list(csv.DictReader(file))
    assert table[0]["algo.learning_rate"] == "0.0002"
    assert (table[1]["interquartile_mean"], table[1]["low"], table[1]["jobs"]) == (
        "11.5",
        "10.75",
        "0 1 2 3",
    )


@pytest.mark.parametrize(
    ("values", "middle", "name"),
    [
        ((1.0, 9.0), 5.0, "mean"),
        ((1.0, 2.0, 9.0), 2.0, "median"),
        ((1.0, 2.0, 4.0, 9.0), 3.0, "interquartile mean"),
        ((1.0, 2.0, 3.0, 4.0, 90.0), 3.0, "interquartile mean"),
    ],
)
def test_the_middle_of_few_seeds_is_called_what_it_is(
    values: tuple[float, ...], middle: float, name: str
) -> None:
    assert seed_summary(np.array(values)).mean == middle
    assert name_of_middle(len(values)) == name


def test_a_sweep_that_stops_prints_the_whole_command_that_goes_on(tmp_path: Path) -> None:
    words = ["env=ant", "run.dir=here", "algo.entropy_cost=1e-2,3e-2"]
    work = build_sweep(words)
    error = JobInterrupted("interrupted")
    runner._say_how_to_continue(error, work, list(work.jobs), SweepPaths(tmp_path / "a b"))
    (note,) = error.__notes__
    *_, folder, task, rate = shlex.split(note.removeprefix("to continue: "))
    assert (folder, task, rate) == (f"run.dir={tmp_path}/a b", words[0], words[2])
    pack = build_pack(["seed=0,1", "run.name=x"], ["echo", "{seed}", "run.dir=own"])
    assert pack.words == ("seed=0,1", "--", "echo", "{seed}", "run.dir=own")


@pytest.mark.parametrize("overrides", [(), ("seed=0,1",)])
def test_a_sweep_without_a_list_says_that_it_is_one_job(overrides: tuple[str, ...]) -> None:
    work, output = build_sweep(["env=ant", *overrides]), io.StringIO()
    here = machine(0)
    site = Site(plan_slots(work.ranking, here, {"auto"}), here)
    announce(Console(file=output, width=300), [site], work, 0)
    assert ("one job, because no key has several values" in output.getvalue()) == (not overrides)


def test_the_middle_of_curves_leaves_out_the_outer_quarters() -> None:
    curves = [[(0, float(k)), (100, float(k))] for k in (0, 1, 2, 3, 100)]
    steps, middle = spread(curves)
    assert (steps[0], steps[-1]) == (0, 100)
    np.testing.assert_allclose(middle.mean, 2.0)
    np.testing.assert_allclose((middle.low[0], middle.high[0]), (1.0, 3.0))
    _, alone = spread([[(0, 1.0), (10, 3.0)]])
    np.testing.assert_allclose(alone.mean, np.linspace(1.0, 3.0, len(alone.mean)))
    _, two = spread([[(0, 1.0), (10, 1.0)], [(0, 3.0), (10, 3.0)]])
    np.testing.assert_allclose(two.mean, 2.0)


def test_a_gpu_goes_to_one_sweep_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, second = LocalHost(machine(0)), LocalHost(machine(0))
    assert first.lease(["GPU-1", "GPU-2"]) is None
    assert second.lease(["GPU-2", "GPU-3"]) == "GPU-2"
    assert first.lease(["GPU-3"]) is None  # Who does not get all holds none.
    first.close()
    assert second.lease(["GPU-2", "GPU-3"]) is None
    second.close()


def test_a_pack_in_a_job_of_a_pack_does_not_wait_for_its_own_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(ENV_PACK_DIR, "runs/outer")
    here = machine(1)
    monkeypatch.setattr(runner, "detect_machine", lambda: here)
    outer = LocalHost(here)
    assert outer.lease([here.gpus[0].uuid]) is None
    inner = [
        "pack.copies=1",
        "pack.jobs_per_gpu=1",
        "pack.backend=share",
        f"run.dir={tmp_path}/in",
    ]
    with pytest.raises(
        ConfigError, match=r"^gmijax pack cannot be .* belongs to runs/outer, which"
    ):
        runner.run_work(build_pack(inner, ["true"]))
    outer.close()


@pytest.mark.parametrize(
    ("rates", "num_jobs", "best", "profiled"),
    [
        ((10.0, 19.0, 30.0, 31.0), 9, 4, [1, 2, 4, 8]),
        ((10.0, 9.0), 9, 1, [1, 2]),
        ((10.0, 19.0, None), 9, 2, [1, 2, 4]),
        ((10.0, 20.0, 40.0), 3, 3, [1, 2, 4]),
        ((), 1, 1, []),
    ],
    ids=[
        "more gain nothing",
        "two are slower",
        "memory ends",
        "no more than there are",
        "one job",
    ],
)
def test_jobs_at_a_time_by_profiling(
    rates: tuple[float | None, ...],
    num_jobs: int,
    best: int,
    profiled: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    done: list[int] = []

    def profile(_: SweepConfig, __: Job, count: int, *___: Any) -> Measured | NotRunnable:
        done.append(count)
        rate = rates[len(done) - 1]
        return NotRunnable("no memory") if rate is None else Measured(rate / count, 100.0, 0.1)

    monkeypatch.setattr(jobs_per_gpu, "profile_jobs", profile)
    jobs = jobs_of([compose(f"seed={seed}") for seed in range(num_jobs)])
    hosts = [LocalHost(machine(1, mps_control=Path("/usr/bin/nvidia-cuda-mps-control")))]
    for _ in range(2):  # The second time by the store.
        found = with_jobs_per_gpu(
            SweepConfig(), jobs, hosts, open_console(show=True), StopSignals()
        )
        assert found.jobs_per_gpu == best
    assert done == profiled
    assert capsys.readouterr().out.count("they compile first") == len(profiled)
    done.clear()  # Larger jobs are others.
    large = jobs_of([compose(f"seed={n}", "plan.gmis_per_gpu=2") for n in range(num_jobs)])
    with_jobs_per_gpu(SweepConfig(), large, hosts, open_console(show=False), StopSignals())
    assert done == profiled


MPS = Path("/usr/bin/nvidia-cuda-mps-control")


@pytest.mark.parametrize(
    ("num_jobs", "millions", "memory_mib", "mps", "profiled", "expected"),
    [
        (3, 39, 100.0, MPS, [1], 3),
        (3, 41, 100.0, MPS, [1, 2, 4], 2),
        (30, 3.9, 100.0, MPS, [1], 8),
        (8, 1, 20_000.0, MPS, [1], 5),
        (8, 1, 90_000.0, MPS, [1], 1),
        (3, 1, 100.0, None, [1, 2, 4], 2),
        (3, 1, 1.0, MPS, [1, 2, 4], 2),
    ],
    ids=["short", "long", "many", "large", "as large as the GPU", "no MPS", "unknown memory"],
)
def test_what_is_soon_over_is_not_profiled_for_long(
    num_jobs: int,
    millions: float,
    memory_mib: float,
    mps: Path | None,
    profiled: list[int],
    expected: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[int] = []
    rates = {1: 1e6, 2: 0.8e6, 4: 1e5}

    def profile(_: SweepConfig, __: Job, count: int, *___: Any) -> Measured:
        done.append(count)
        return Measured(rates[count], memory_mib, 0.1)

    def chosen(num_jobs: int, millions: float, *overrides: str) -> int | str:
        line = (f"num_timesteps={int(millions * 1e6)}", *overrides)
        jobs = jobs_of([compose(f"seed={seed}", *line) for seed in range(num_jobs)])
        hosts, quiet = [LocalHost(machine(1, mps_control=mps))], open_console(show=False)
        return with_jobs_per_gpu(SweepConfig(), jobs, hosts, quiet, StopSignals()).jobs_per_gpu

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(jobs_per_gpu, "profile_jobs", profile)
    assert (chosen(num_jobs, millions), done) == (expected, profiled)
    # What was measured for a longer sweep is taken.
    assert chosen(2, 1000) == 2
    assert done[-1] == 2 or profiled == [1, 2, 4]
    assert chosen(3, 1000) == 2
    assert chosen(num_jobs, millions) == 2
    assert done == [1, 2, 4]


def test_the_longest_job_of_a_kind_says_whether_they_are_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[int] = []

    def profile(_: SweepConfig, __: Job, count: int, *___: Any) -> Measured:
        done.append(count)
        return Measured(1e6 / count, 100.0, 0.1)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(jobs_per_gpu, "profile_jobs", profile)
    jobs = jobs_of([compose(f"num_timesteps={steps}") for steps in (1_000_000, 1_000_000_000)])
    hosts, quiet = [LocalHost(machine(1, mps_control=MPS))], open_console(show=False)
    with_jobs_per_gpu(SweepConfig(), jobs, hosts, quiet, StopSignals())
    assert done == [1, 2]


@pytest.mark.parametrize(
    ("settings", "override", "expected"),
    [
        ({}, "plan.gpus=1", 2),
        ({"gpus": 1}, "plan.gpus=1", 3),
        ({"gpus": (1,)}, "plan.gpus=1", 3),
        ({}, "plan.gpus=2", 3),
        ({"sampler": "tpe", "trials": 8}, "plan.gpus=1", 4),
    ],
)
def test_no_more_at_a_time_than_let_all_jobs_run(
    settings: dict[str, Any],
    override: str,
    expected: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def profile(*_: Any) -> Measured:
        return Measured(100.0, 100.0, 0.1)  # Each as fast as alone, however many there are.

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(jobs_per_gpu, "profile_jobs", profile)
    jobs = jobs_of([compose(f"seed={seed}", override) for seed in range(3)])
    hosts, quiet = [LocalHost(machine(2))], open_console(show=False)
    found = with_jobs_per_gpu(SweepConfig(**settings), jobs, hosts, quiet, StopSignals())
    assert found.jobs_per_gpu == expected


def test_a_profile_of_a_job_is_not_sent_anywhere() -> None:
    [job] = jobs_of([compose("wandb.mode=online", "eval.every=100")])
    profiled = profiled_job(job, 1, 10**12).config
    assert (profiled.wandb.mode, profiled.eval.every) == ("off", None)


def test_without_a_gpu_a_job_has_two_cores() -> None:
    jobs, small = jobs_of([compose()]), LocalHost(machine(0, cpu_cores=tuple(range(8))))
    large = LocalHost(machine(0, cpu_cores=tuple(range(64))))
    quiet = open_console(show=False)
    for hosts in ([small], [large, small]):
        found = with_jobs_per_gpu(SweepConfig(), jobs, hosts, quiet, StopSignals())
        assert found.jobs_per_gpu == 4
    asked = SweepConfig(jobs_per_gpu=7)
    assert with_jobs_per_gpu(asked, jobs, [small], quiet, StopSignals()) == asked


def test_a_profile_counts_while_all_jobs_train(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(curve_window, "running_s", lambda: now_s)
    jobs = jobs_of([compose(f"seed={seed}") for seed in range(2)])
    window = CurveWindow(jobs, 60.0)
    while not window.is_over():
        now_s += 0.5
        jobs[0].progress.env_steps += 50
        # The second one compiles for ten seconds.
        jobs[1].progress.env_steps += 50 if now_s > 10.0 else 0
    assert window.steps_per_s == pytest.approx(200.0)
    assert window.iteration_s == pytest.approx(0.5)
    assert 14.0 < now_s < 18.0
    late = CurveWindow(jobs, 5.0)
    now_s += 6.0
    assert late.is_over()
    assert late.steps_per_s is None


def test_a_folder_that_a_job_holds_is_known(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    assert not is_locked(tmp_path / "nowhere" / ".lock")
    assert not is_locked(lock)
    with locked(lock, "here"):
        assert is_locked(lock)
    assert not is_locked(lock)

"""What is measured: suites of named training commands. Data only."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

from gmijax.partition.layout import Layout
from gmijax.partition.reduction import select_strategy


class Case(NamedTuple):
    """One command line of `python -m gmijax.train`.

    Attributes:
      name: what tables call it.
      overrides: its hydra overrides; `{run}` in them is the number of the repeat, 0 for the first.
      gpus: how many GPUs it needs.
    """

    name: str
    overrides: tuple[str, ...]
    gpus: int = 1


TASKS = ("ant", "anymal", "ball_balance", "franka_cabinet", "humanoid", "shadow_hand")

# Where the settings of a task ask for much more than it takes to learn it, fewer steps. Those of
# ball_balance are made for a CPU.
_LEARNING = {
    "ant": ("num_timesteps=60e6",),
    "anymal": ("num_timesteps=60e6",),
    "ball_balance": ("num_envs=4096", "num_timesteps=10e6"),
    "franka_cabinet": ("num_timesteps=50e6",),
    "humanoid": ("num_timesteps=80e6",),
    "shadow_hand": ("num_timesteps=120e6",),
}


def _learning(task: str) -> Case:
    own = _LEARNING.get(task, ())
    return Case(task, (f"env={task}", "seed={run}", *own, "run.measure_throughput=false"))


def _throughput(task: str, impl: str, num_envs: int) -> Case:
    # A dozen iterations of the longest rollout: their median is the training rate.
    steps = 12 * 32 * num_envs
    return Case(
        f"{task} {impl} {num_envs}",
        (
            f"env={task}",
            f"physics.impl={impl}",
            f"num_envs={num_envs}",
            f"num_timesteps={steps}",
            "run.checkpoint_every=0",
        ),
    )


PLANS = ((1, 65536), (4, 16384), (2, 32768), (1, 32768))
"""GMIs on one GPU and environments in each, where it is near saturation."""


def _plan(task: str, gmis: int, num_envs: int) -> Case:
    return Case(
        f"{task} {gmis} x {num_envs}",
        (
            f"env={task}",
            "physics.impl=warp",
            f"num_envs={num_envs}",
            f"plan.gmis_per_gpu={gmis}",
            # Eight iterations of the longest rollout.
            f"num_timesteps={8 * 32 * gmis * num_envs}",
            "run.measure_throughput=false",
            "run.checkpoint_every=0",
        ),
    )


def _templates(task: str, num_envs: int) -> tuple[Case, ...]:
    """The same environments in GMIs that do everything, and in GMIs that a third one trains."""
    # A dozen iterations of the longest rollout.
    shared = (
        *(f"env={task}", f"num_envs={num_envs}", f"num_timesteps={12 * 32 * 2 * num_envs}"),
        *("plan.backend=mps", "run.measure_throughput=false", "run.checkpoint_every=0"),
        # Both as the paper has them: gradients through host memory.
        "reduce.strategy=paper",
    )
    return (
        Case(f"2 GMIs x {num_envs}, tcg_ex", (*shared, "plan.gmis_per_gpu=2")),
        Case(
            f"2 + 1 GMIs x {num_envs}, tdg_ex",
            (*shared, "plan.gmis_per_gpu=3", "plan.template=tdg_ex"),
        ),
    )


_ANT = ("env=ant", "physics.impl=jax", "run.checkpoint_every=0")
_THIRTY = (*_ANT, "num_timesteps=30e6")
_TWO_GPUS = (*_THIRTY, "plan.gpus=2", "run.measure_throughput=false")


_ASYNC = (*_ANT, "algo=a3c", "plan.backend=mps", "channel.capacity_mib=256")


def _async(name: str, gpus: int, num_envs: int, *overrides: str) -> Case:
    """Agents with `num_envs` environments each, and trainers."""
    own = (f"num_envs={num_envs}", "num_timesteps=30e6", *overrides)
    return Case(name, (*_ASYNC, *own), gpus)


def _on(serving: str, training: str, agents: int, trainers: int) -> tuple[str, ...]:
    return (
        *(f"plan.serving_gpus={serving}", f"plan.training_gpus={training}"),
        *(f"plan.serving_gmis_per_gpu={agents}", f"plan.training_gmis_per_gpu={trainers}"),
    )


def _channel_designs(task: str, num_envs: int) -> tuple[Case, ...]:
    """The paper's table: one GPU acts, one trains; experience by channels, or tensor by tensor."""
    shared = (
        *(f"env={task}", "algo=a3c", f"num_envs={num_envs}", "run.checkpoint_every=0"),
        *(f"num_timesteps={40 * 16 * num_envs}", "channel.capacity_mib=256", *_on("1", "1", 1, 1)),
    )
    return tuple(
        Case(f"{task} {design}", (*shared, f"channel.design={design}"), 2)
        for design in ("uni", "multi")
    )


def _lgr(task: str, gpus: int, gmis: int, strategy: str) -> Case:
    """A cell of the paper's table of LGR: so many GPUs with so many trainers each."""
    return Case(
        f"{gpus}G{gmis}T {strategy}",
        (
            f"env={task}",
            "num_envs=2048",
            # A dozen iterations of the longest rollout.
            f"num_timesteps={12 * 32 * 2048 * gpus * gmis}",
            f"plan.gpus={gpus}",
            f"plan.gmis_per_gpu={gmis}",
            "plan.backend=mps",
            f"reduce.strategy={strategy}",
            "run.measure_throughput=false",
            "run.checkpoint_every=0",
        ),
        gpus,
    )


def _scaling(gpus: int, gmis: int, strategy: str) -> Case:
    """8192 environments on every GPU: weak scaling."""
    strategy = "auto" if gpus * gmis == 1 else strategy
    return Case(
        f"{gpus} GPUs x {gmis} GMIs x {8192 // gmis}",
        (
            "env=ant",
            f"num_envs={8192 // gmis}",
            f"num_timesteps={40 * 16 * 8192 * gpus}",
            f"plan.gpus={gpus}",
            f"plan.gmis_per_gpu={gmis}",
            f"reduce.strategy={strategy}",
            "run.measure_throughput=false",
            "run.checkpoint_every=0",
        ),
        gpus,
    )


_LONG = ("env=ant", "physics.impl=warp", "num_timesteps=100e6", "run.measure_throughput=false")


def _long(name: str, gpus: int, num_envs: int, *overrides: str) -> Case:
    """100M steps of ant, with one agent on each GPU unless `overrides` say otherwise."""
    return Case(name, (*_LONG, f"num_envs={num_envs}", *overrides), gpus)


_GO1 = (
    *("env=playground", "env.name=Go1JoystickFlatTerrain", "tuned=locomotion_ppo"),
    *("num_timesteps=100e6", "eval.every=10e6", "seed={run}", "run.measure_throughput=false"),
)
_ASYNC_LONG = ("algo=a3c", "plan.backend=mps", "channel.capacity_mib=256")
_ON_ONE = "channel.transport=device"

SUITES = MappingProxyType(
    {
        # Every task: one process against several GMIs, each with as many environments as it takes.
        "plans": tuple(_plan(task, *plan) for plan in PLANS for task in TASKS),
        # Playground's own settings; Go1 for half of its steps, by both kinds of value function.
        "playground": (
            Case("Go1JoystickFlatTerrain", _GO1),
            Case("Go1JoystickFlatTerrain, symmetric", (*_GO1, "algo.value_obs_key=state")),
            Case(
                "CartpoleBalance",
                (
                    *("env=playground", "env.name=CartpoleBalance", "tuned=dm_control_ppo"),
                    *("eval.every=6e6", "seed={run}", "run.measure_throughput=false"),
                ),
            ),
        ),
        # Long enough that whole runs can be compared.
        "async-long": (
            _long("1 GPU, synchronous", 1, 8192),
            _long(
                *("1 GPU, 2 agents + 1 trainer", 1, 4096, *_ASYNC_LONG, _ON_ONE),
                "plan.serving_gmis_per_gpu=2",
            ),
            _long("2 GPUs, synchronous", 2, 8192, "plan.gpus=2"),
            _long("1 + 1 GPUs, one process each", 2, 8192, *_ASYNC_LONG, *_on("1", "1", 1, 1)),
            _long(
                "1 + 1 GPUs, 4 agents + 2 trainers", 2, 2048, *_ASYNC_LONG, *_on("1", "1", 4, 2)
            ),
        ),
        # Acting and learning on one GPU, with the same 8192 environments as in one GMI.
        "async-1gpu": (
            Case("sync, 1 GMI x 8192", (*_THIRTY, "num_envs=8192")),
            _async("1 agent x 8192 + 1 trainer", 1, 8192),
            _async("2 agents x 4096 + 1 trainer", 1, 4096, "plan.serving_gmis_per_gpu=2"),
            _async("4 agents x 2048 + 1 trainer", 1, 2048, "plan.serving_gmis_per_gpu=4"),
        ),
        # One process a GPU against several, and against GPUs that do both.
        "async-2gpu": (
            _async("1 + 1 GPUs, one process each", 2, 8192, *_on("1", "1", 1, 1)),
            _async("1 + 1 GPUs, 4 agents + 2 trainers", 2, 2048, *_on("1", "1", 4, 2)),
            _async("2 GPUs, each 3 agents + 1 trainer", 2, 2048, *_on("[0,1]", "[0,1]", 3, 1)),
        ),
        "async-4gpu": (
            _async("3 + 1 GPUs, one process each", 4, 8192, *_on("3", "1", 1, 1)),
            _async("3 + 1 GPUs, 4 agents + 2 trainers", 4, 2048, *_on("3", "1", 4, 2)),
            _async(
                *("3 + 1 GPUs, 4 agents + 2 trainers, har, batches of 4 agents", 4, 2048),
                *(*_on("3", "1", 4, 2), "algo.batch_size=8192", "reduce.strategy=har"),
            ),
            _async(
                *("4 GPUs, each 3 agents + 1 trainer", 4, 2048),
                *_on("[0,1,2,3]", "[0,1,2,3]", 3, 1),
            ),
        ),
        "async-channels": (
            *_channel_designs("ant", 4096),
            *_channel_designs("anymal", 2048),
            *_channel_designs("humanoid", 2048),
        ),
        # The same 8192 environments on one GPU: together, and in four GMIs.
        "ant-1gpu": (
            Case("1 GMI x 8192", (*_THIRTY, "num_envs=8192")),
            Case(
                "4 GMIs x 2048, mps",
                (*_THIRTY, "num_envs=2048", "plan.gmis_per_gpu=4", "plan.backend=mps"),
            ),
            Case(
                "4 GMIs x 2048, share",
                (*_THIRTY, "num_envs=2048", "plan.gmis_per_gpu=4", "plan.backend=share"),
            ),
        ),
        # Trainers among their simulators, and in GMIs of their own.
        **{f"templates-{task}": _templates(task, 2048) for task in ("ant", "humanoid")},
        "ant-2gpu": (
            Case(
                "2 GPUs x 2 GMIs x 2048, mps",
                (*_TWO_GPUS, "num_envs=2048", "plan.gmis_per_gpu=2", "plan.backend=mps"),
                2,
            ),
            Case(
                "2 GPUs x 2 GMIs x 2048, share",
                (*_TWO_GPUS, "num_envs=2048", "plan.gmis_per_gpu=2", "plan.backend=share"),
                2,
            ),
        ),
        # Every task, both implementations of MJX, one GMI.
        **{
            f"tasks-{impl}": tuple(
                _throughput(task, impl, num_envs)
                for num_envs in (2048, 8192, 32768)
                for task in TASKS
            )
            for impl in ("jax", "warp")
        },
        # Every task with its own settings, another seed in every repeat.
        **{f"learn-{task}": (_learning(task),) for task in TASKS},
        # Gradients through host memory against what Algorithm 1 of the paper takes.
        **{
            f"lgr-{task}": tuple(
                _lgr(task, gpus, gmis, strategy)
                for gpus, gmis in ((2, 2), (2, 3), (4, 4))
                for strategy in ("mpr", select_strategy(Layout.even(gpus, gmis)).strategy)
            )
            for task in ("ant", "humanoid", "shadow_hand")
        },
        # The same without rings, beside mpr in one run.
        **{
            f"lgr-{task}-one_shot": tuple(
                _lgr(task, gpus, gmis, strategy)
                for gpus, gmis in ((2, 2), (2, 3), (4, 4))
                for strategy in ("mpr", "one_shot")
            )
            for task in ("ant", "humanoid", "shadow_hand")
        },
        "scaling": tuple(
            _scaling(gpus, gmis, strategy)
            for gmis, strategy in ((1, "flat"), (2, "har"))
            for gpus in (1, 2, 4, 8)
        ),
        "scaling-one_shot": tuple(
            _scaling(gpus, gmis, "one_shot") for gmis in (1, 2) for gpus in (1, 2, 4, 8)
        ),
    }
)
"""Suite -> cases. Ratios are taken within a suite, whose cases run in turn."""

"""What is measured: suites of named training commands. Data only."""

from __future__ import annotations

from types import MappingProxyType

from benchmarks.case import Case
from benchmarks.reduction_cases import REDUCTION

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


def _entropy(cost: str) -> Case:
    """Whether noise that is paid for finds the pull that some seeds of the task never find."""
    own = ("num_timesteps=20e6", f"algo.entropy_cost={cost}", "run.measure_throughput=false")
    return Case(f"entropy_cost {cost}", ("env=franka_cabinet", "seed={run}", *own))


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


def _templates(task: str, num_envs: int) -> tuple[Case, ...]:
    """The same environments in GMIs that do everything, and in GMIs that a third one trains."""
    # A dozen iterations of the longest rollout.
    shared = (
        *(f"env={task}", f"num_envs={num_envs}", f"num_timesteps={12 * 32 * 2 * num_envs}"),
        *("plan.backend=mps", "run.measure_throughput=false", "run.checkpoint_every=0"),
        # Both as the paper has them: gradients through host memory.
        "reduce.selection=paper",
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


def _capped(percent: str) -> Case:
    steps = 24 * 16 * 4 * 4096
    return Case(
        f"4 GMIs x 4096, cap {percent}",
        (
            *_ANT,
            *("num_envs=4096", "plan.gmis_per_gpu=4", "plan.backend=mps"),
            *(f"plan.sm_percent={percent}", "plan.force_sm_percent=true", "plan.self_check=off"),
            *(f"num_timesteps={steps}", "run.measure_throughput=false"),
        ),
    )


_ASYNC = (*_ANT, "algo=a3c", "plan.backend=mps", "channel.capacity_mib=256")


def _async(name: str, gpus: int, num_envs: int, *overrides: str, steps: float = 30e6) -> Case:
    """Agents with `num_envs` environments each, and trainers."""
    own = (f"num_envs={num_envs}", f"num_timesteps={steps:.0f}", *overrides)
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


SUITES = MappingProxyType(
    {
        # Acting and learning on one GPU, with the same 8192 environments as in one GMI.
        "async-1gpu": (
            Case("sync, 1 GMI x 8192", (*_THIRTY, "num_envs=8192")),
            _async("1 agent x 8192 + 1 trainer", 1, 8192),
            _async("2 agents x 4096 + 1 trainer", 1, 4096, "plan.serving_gmis_per_gpu=2"),
            _async("4 agents x 2048 + 1 trainer", 1, 2048, "plan.serving_gmis_per_gpu=4"),
        ),
        # The same with caps on SMs, the trainer's first, and with larger batches.
        "async-1gpu-shares": (
            _async("trainer 25 %", 1, 8192, "plan.sm_percent=[25,100]"),
            _async("trainer 50 %, agent 50 %", 1, 8192, "plan.sm_percent=[50,50]"),
            _async(
                *("2 agents, batches of both", 1, 4096),
                *("plan.serving_gmis_per_gpu=2", "algo.batch_size=8192"),
            ),
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
        # How fast and how far both learn.
        "async-learns": (
            Case("sync", (*_ANT, "num_envs=4096", "num_timesteps=60e6", "seed={run}")),
            *(
                _async(
                    *(f"async, 2 agents x 2048 + 1 trainer, {transport}", 1, 2048),
                    *("plan.serving_gmis_per_gpu=2", "plan.mps_priority=trainers_first"),
                    *(f"channel.transport={transport}", "seed={run}"),
                    steps=60e6,
                )
                for transport in ("memory", "device")
            ),
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
        # What one GMI does with the environments that each of the four had.
        "ant-small": (Case("1 GMI x 2048", (*_THIRTY, "num_envs=2048")),),
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
        # Plain data parallelism: the same environments with one GMI on each GPU.
        "ant-2gpu-one-each": (Case("2 GPUs x 1 GMI x 4096", (*_TWO_GPUS, "num_envs=4096"), 2),),
        "ant-learns": (Case("1 GMI x 8192", (*_ANT, "num_envs=8192", "num_timesteps=150e6")),),
        # Every task, both implementations of MJX, one GMI.
        **{
            f"tasks-{impl}": tuple(
                _throughput(task, impl, num_envs)
                for num_envs in (2048, 8192, 32768)
                for task in TASKS
            )
            for impl in ("jax", "warp")
        },
        # What a cap on SMs does to four GMIs; docs/shares.md.
        "sm-shares": tuple(_capped(percent) for percent in ("null", "25", "50", "100", "33")),
        # Every task with its own settings, another seed in every repeat.
        **{f"learn-{task}": (_learning(task),) for task in TASKS},
        # What ant learns from as many steps of the other MJX.
        "learn-ant-jax": (
            Case(
                "ant jax",
                (*_ANT, "seed={run}", "num_timesteps=60e6", "run.measure_throughput=false"),
            ),
        ),
        "entropy-franka_cabinet": tuple(map(_entropy, ("0", "0.002", "0.005"))),
        **REDUCTION,
        "ball-cpu": (Case("2 GMIs x 512", ("env=ball_balance", "plan.gpus=2")),),
    }
)
"""Suite -> cases. Ratios are taken within a suite, whose cases run in turn."""

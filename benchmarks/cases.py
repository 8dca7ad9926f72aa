"""What is measured: suites of named training commands. Data only."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

from gmijax.sim.impl import ON_GPU


class Case(NamedTuple):
    """One command line of `python -m gmijax.train`.

    Attributes:
      name: what tables call it.
      overrides: its hydra overrides; `{run}` in them is the number of the repeat, 0 for the first.
    """

    name: str
    overrides: tuple[str, ...]


TASKS = ("ant", "anymal", "ball_balance", "franka_cabinet", "humanoid", "shadow_hand")

# Where the settings of a task ask for much more than it takes to learn it, fewer steps. Those of
# ball_balance are made for a CPU.
_LEARNING = {
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


_ANT = ("env=ant", "physics.impl=jax", "run.checkpoint_every=0")
_THIRTY = (*_ANT, "num_timesteps=30e6")
_TWO_GPUS = (*_THIRTY, "plan.gpus=2", "run.measure_throughput=false")

SUITES = MappingProxyType(
    {
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
        # What one GMI does with the environments that each of the four had.
        "ant-small": (Case("1 GMI x 2048", (*_THIRTY, "num_envs=2048")),),
        "ant-2gpu": (
            Case(
                "2 GPUs x 2 GMIs x 2048, mps",
                (*_TWO_GPUS, "num_envs=2048", "plan.gmis_per_gpu=2", "plan.backend=mps"),
            ),
            Case(
                "2 GPUs x 2 GMIs x 2048, share",
                (*_TWO_GPUS, "num_envs=2048", "plan.gmis_per_gpu=2", "plan.backend=share"),
            ),
        ),
        # Plain data parallelism: the same environments with one GMI on each GPU.
        "ant-2gpu-one-each": (Case("2 GPUs x 1 GMI x 4096", (*_TWO_GPUS, "num_envs=4096")),),
        "ant-learns": (Case("1 GMI x 8192", (*_ANT, "num_envs=8192", "num_timesteps=150e6")),),
        # Every task, both implementations of MJX, one GMI.
        **{
            f"tasks-{impl}": tuple(
                _throughput(task, impl, num_envs)
                for num_envs in (2048, 8192, 32768)
                for task in TASKS
                if impl == "jax" or not ON_GPU[task].why_no_warp
            )
            for impl in ("jax", "warp")
        },
        # Every task with its own settings, another seed in every repeat.
        **{f"learn-{task}": (_learning(task),) for task in TASKS},
        "ball-cpu": (Case("2 GMIs x 512", ("env=ball_balance", "plan.gpus=2")),),
    }
)
"""Suite -> cases. Ratios are taken within a suite, whose cases run in turn."""

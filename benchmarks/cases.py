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


def _case(name: str, overrides: str, gpus: int = 1) -> Case:
    return Case(name, tuple(overrides.split()), gpus)


TASKS = ("ant", "anymal", "ball_balance", "franka_cabinet", "humanoid", "shadow_hand")
REWARD = ("ant", "anymal", "humanoid")
"""Tasks of the paper's figure 9."""

PLANS = ((1, 65536), (4, 16384), (2, 32768))
"""GMIs on one GPU and environments in each, where it is near saturation."""

_RATES, _NO_CHECKPOINTS = "run.measure_throughput=true", "run.checkpoint_every=0"


def _throughput(task: str, num_envs: int) -> Case:
    # A dozen iterations of the longest rollout: their median is the training rate.
    return _case(
        f"{task} warp {num_envs}",
        f"env={task} physics.impl=warp num_envs={num_envs} num_timesteps={12 * 32 * num_envs} "
        f"{_RATES} {_NO_CHECKPOINTS}",
    )


def _plan(task: str, gmis: int, num_envs: int) -> Case:
    # Eight iterations of the longest rollout.
    return _case(
        f"{task} {gmis} x {num_envs}",
        f"env={task} physics.impl=warp num_envs={num_envs} plan.gmis_per_gpu={gmis} "
        f"num_timesteps={8 * 32 * gmis * num_envs} {_NO_CHECKPOINTS}",
    )


def _templates(task: str) -> tuple[Case, ...]:
    """The same environments in GMIs that do everything, and in GMIs that a third one trains."""
    # A dozen iterations of the longest rollout. Both as the paper has them: gradients through
    # host memory.
    shared = (
        f"env={task} num_envs=2048 num_timesteps={12 * 32 * 2 * 2048} plan.backend=mps "
        f"{_NO_CHECKPOINTS} reduce.strategy=paper"
    )
    return (
        _case("2 GMIs x 2048, tcg_ex", f"{shared} plan.gmis_per_gpu=2"),
        _case("2 + 1 GMIs x 2048, tdg_ex", f"{shared} plan.gmis_per_gpu=3 plan.template=tdg_ex"),
    )


def _async(name: str, num_envs: int, overrides: str) -> Case:
    """Agents with `num_envs` environments each, and trainers, on four GPUs."""
    own = f"env=ant {_NO_CHECKPOINTS} {_A3C} num_envs={num_envs} num_timesteps=200e6"
    return _case(name, f"{own} {overrides}", 4)


def _on(serving: str, training: str, agents: int, trainers: int) -> str:
    return (
        f"plan.serving_gpus={serving} plan.training_gpus={training} "
        f"plan.serving_gmis_per_gpu={agents} plan.training_gmis_per_gpu={trainers}"
    )


def _channel_designs(task: str) -> tuple[Case, ...]:
    """The paper's table: one GPU acts, one trains; experience by channels, or tensor by tensor."""
    shared = (
        f"env={task} algo=a3c num_envs=2048 num_timesteps=10e6 channel.capacity_mib=256 "
        f"{_on('1', '1', 1, 1)} {_NO_CHECKPOINTS}"
    )
    return tuple(
        _case(f"{task} {design}", f"{shared} channel.design={design}", 2)
        for design in ("uni", "multi")
    )


def _lgr(task: str) -> tuple[Case, ...]:
    """Cells of the paper's table of LGR: so many GPUs with so many trainers each.

    Gradients through host memory (`mpr`), and in GPU memory by what Algorithm 1 takes and by
    `one_shot`.
    """
    return tuple(
        _case(
            f"{gpus}G{gmis}T {strategy}",
            # A dozen iterations of the longest rollout.
            f"env={task} num_envs=2048 num_timesteps={12 * 32 * 2048 * gpus * gmis} "
            f"plan.gpus={gpus} plan.gmis_per_gpu={gmis} plan.backend=mps "
            f"reduce.strategy={strategy} {_NO_CHECKPOINTS}",
            gpus,
        )
        for gpus, gmis in ((2, 2), (2, 3), (4, 4))
        for strategy in ("mpr", select_strategy(Layout.even(gpus, gmis)).strategy, "one_shot")
    )


def _scaling(gpus: int, gmis: int, backend: str = "auto") -> Case:
    """Ant with 8192 environments on every GPU: in one process, or in several GMIs."""
    num_envs = 8192 // gmis
    return _case(
        f"{gpus} GPUs x {gmis} GMIs x {num_envs}" + ", share" * (backend == "share"),
        f"env=ant num_envs={num_envs} num_timesteps={60 * 16 * 8192 * gpus} plan.gpus={gpus} "
        f"plan.gmis_per_gpu={gmis} plan.backend={backend} {_NO_CHECKPOINTS}",
        gpus,
    )


def _reward(task: str, gmis: int) -> Case:
    """A training with 8192 environments on one GPU, another seed in every repeat."""
    return _case(
        f"{task} {gmis} x {8192 // gmis}",
        f"env={task} num_envs={8192 // gmis} num_timesteps=50e6 plan.gmis_per_gpu={gmis} "
        f"seed={{run}} {_NO_CHECKPOINTS}",
    )


def _sac(gpus: int, batch_size: int) -> Case:
    """SAC with 4096 environments on every GPU, and so many transitions of its replay an update."""
    return _case(
        f"{gpus} GPUs x 4096, batches of {gpus} x {batch_size}",
        f"env=ant algo=sac num_envs=4096 num_timesteps={64 * 16 * 4096 * gpus} plan.gpus={gpus} "
        f"algo.batch_size={batch_size} {_NO_CHECKPOINTS}",
        gpus,
    )


def _long(name: str, gpus: int, num_envs: int, overrides: str = "") -> Case:
    """100M steps of ant, with one agent on each GPU unless `overrides` say otherwise."""
    own = f"env=ant physics.impl=warp num_timesteps=100e6 num_envs={num_envs}"
    return _case(name, f"{own} {overrides}", gpus)


_A3C = "algo=a3c plan.backend=mps channel.capacity_mib=256"
_ON_ONE = "channel.transport=device plan.serving_gmis_per_gpu=2"
_ONE_EACH, _SEVERAL = "one process each", "4 agents + 2 trainers"

_DECOUPLED = f"3 + 1 GPUs, {_SEVERAL}"

SUITES = MappingProxyType(
    {
        # Every task: one process against several GMIs, each with as many environments as it takes.
        "plans": tuple(_plan(task, *plan) for plan in PLANS for task in TASKS),
        # Long enough that whole runs can be compared.
        "async-long": (
            _long("1 GPU, synchronous", 1, 8192),
            _long("1 GPU, 2 agents + 1 trainer", 1, 4096, f"{_A3C} {_ON_ONE}"),
            _long("2 GPUs, synchronous", 2, 8192, "plan.gpus=2"),
            _long(f"1 + 1 GPUs, {_ONE_EACH}", 2, 8192, f"{_A3C} {_on('1', '1', 1, 1)}"),
            _long(f"1 + 1 GPUs, {_SEVERAL}", 2, 2048, f"{_A3C} {_on('1', '1', 4, 2)}"),
        ),
        # One process a GPU against several.
        "async-4gpu": (
            _async(f"3 + 1 GPUs, {_ONE_EACH}", 8192, _on("3", "1", 1, 1)),
            _async(_DECOUPLED, 2048, _on("3", "1", 4, 2)),
            _async(
                *(f"{_DECOUPLED}, har, batches of 4 agents", 2048),
                f"{_on('3', '1', 4, 2)} algo.batch_size=8192 reduce.strategy=har",
            ),
        ),
        "async-channels": (*_channel_designs("anymal"), *_channel_designs("franka_cabinet")),
        # Several learners, each with its own replay, against one.
        "sac-2gpu": (_sac(1, 32768), _sac(2, 16384), _sac(2, 32768)),
        # Trainers among their simulators, and in GMIs of their own.
        **{f"templates-{task}": _templates(task) for task in ("ant", "humanoid")},
        # Every task, one GMI; of two tasks other sizes too.
        "tasks-warp": tuple(
            _throughput(task, num_envs)
            for num_envs in (512, 2048, 8192, 32768)
            for task in (TASKS if num_envs == 8192 else ("ant", "humanoid"))
        ),
        # Figure 9.
        **{f"reward-{task}": (_reward(task, 1), _reward(task, 4)) for task in REWARD},
        **{f"lgr-{task}": _lgr(task) for task in ("ant", "humanoid", "shadow_hand")},
        "scaling": (
            *(_scaling(1, gmis) for gmis in (1, 2, 4)),
            _scaling(1, 4, "share"),
            *(_scaling(gpus, gmis) for gpus in (2, 4) for gmis in (1, 2)),
            _scaling(2, 2, "share"),
        ),
    }
)
"""Suite -> cases. Ratios are taken within a suite, whose cases run in turn."""

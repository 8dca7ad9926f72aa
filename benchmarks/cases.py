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
PLANS = ((1, 65536), (4, 16384), (2, 32768), (1, 32768))
"""GMIs on one GPU and environments in each, where it is near saturation."""

_NO_RATES, _NO_CHECKPOINTS = "run.measure_throughput=false", "run.checkpoint_every=0"

# Where the settings of a task ask for much more than it takes to learn it, fewer steps. Those of
# ball_balance are made for a CPU.
_LEARNING = {
    "ant": "num_timesteps=60e6",
    "anymal": "num_timesteps=60e6",
    "ball_balance": "num_envs=4096 num_timesteps=10e6",
    "franka_cabinet": "num_timesteps=50e6",
    "humanoid": "num_timesteps=80e6",
    "shadow_hand": "num_timesteps=120e6",
}


def _throughput(task: str, impl: str, num_envs: int) -> Case:
    # A dozen iterations of the longest rollout: their median is the training rate.
    return _case(
        f"{task} {impl} {num_envs}",
        f"env={task} physics.impl={impl} num_envs={num_envs} num_timesteps={12 * 32 * num_envs} "
        f"{_NO_CHECKPOINTS}",
    )


def _plan(task: str, gmis: int, num_envs: int) -> Case:
    # Eight iterations of the longest rollout.
    return _case(
        f"{task} {gmis} x {num_envs}",
        f"env={task} physics.impl=warp num_envs={num_envs} plan.gmis_per_gpu={gmis} "
        f"num_timesteps={8 * 32 * gmis * num_envs} {_NO_RATES} {_NO_CHECKPOINTS}",
    )


def _templates(task: str) -> tuple[Case, ...]:
    """The same environments in GMIs that do everything, and in GMIs that a third one trains."""
    # A dozen iterations of the longest rollout. Both as the paper has them: gradients through
    # host memory.
    shared = (
        f"env={task} num_envs=2048 num_timesteps={12 * 32 * 2 * 2048} plan.backend=mps "
        f"{_NO_RATES} {_NO_CHECKPOINTS} reduce.strategy=paper"
    )
    return (
        _case("2 GMIs x 2048, tcg_ex", f"{shared} plan.gmis_per_gpu=2"),
        _case("2 + 1 GMIs x 2048, tdg_ex", f"{shared} plan.gmis_per_gpu=3 plan.template=tdg_ex"),
    )


_ANT = f"env=ant physics.impl=jax {_NO_CHECKPOINTS}"
_THIRTY = f"{_ANT} num_timesteps=30e6"


def _shared(gpus: int, gmis: int, own: str) -> tuple[Case, ...]:
    """GMIs with 2048 environments each, with and without MPS."""
    where = f"{gpus} GPUs x " if gpus > 1 else ""
    return tuple(
        _case(
            f"{where}{gmis} GMIs x 2048, {backend}",
            f"{own} num_envs=2048 plan.gmis_per_gpu={gmis} plan.backend={backend}",
            gpus,
        )
        for backend in ("mps", "share")
    )


def _async(name: str, gpus: int, num_envs: int, overrides: str = "") -> Case:
    """Agents with `num_envs` environments each, and trainers."""
    own = f"{_ANT} algo=a3c plan.backend=mps channel.capacity_mib=256 num_envs={num_envs}"
    return _case(name, f"{own} num_timesteps=30e6 {overrides}", gpus)


def _on(serving: str, training: str, agents: int, trainers: int) -> str:
    return (
        f"plan.serving_gpus={serving} plan.training_gpus={training} "
        f"plan.serving_gmis_per_gpu={agents} plan.training_gmis_per_gpu={trainers}"
    )


def _channel_designs(task: str, num_envs: int) -> tuple[Case, ...]:
    """The paper's table: one GPU acts, one trains; experience by channels, or tensor by tensor."""
    shared = (
        f"env={task} algo=a3c num_envs={num_envs} {_NO_CHECKPOINTS} "
        f"num_timesteps={40 * 16 * num_envs} channel.capacity_mib=256 {_on('1', '1', 1, 1)}"
    )
    return tuple(
        _case(f"{task} {design}", f"{shared} channel.design={design}", 2)
        for design in ("uni", "multi")
    )


def _lgr(task: str, *strategies: str) -> tuple[Case, ...]:
    """Cells of the paper's table of LGR: so many GPUs with so many trainers each.

    Without `strategies`, gradients through host memory against what Algorithm 1 takes.
    """
    return tuple(
        _case(
            f"{gpus}G{gmis}T {strategy}",
            # A dozen iterations of the longest rollout.
            f"env={task} num_envs=2048 num_timesteps={12 * 32 * 2048 * gpus * gmis} "
            f"plan.gpus={gpus} plan.gmis_per_gpu={gmis} plan.backend=mps "
            f"reduce.strategy={strategy} {_NO_RATES} {_NO_CHECKPOINTS}",
            gpus,
        )
        for gpus, gmis in ((2, 2), (2, 3), (4, 4))
        for strategy in strategies or ("mpr", select_strategy(Layout.even(gpus, gmis)).strategy)
    )


def _scaling(*ways: tuple[int, str]) -> tuple[Case, ...]:
    """8192 environments on every GPU: weak scaling, by GMIs on each and their strategy."""
    return tuple(
        _case(
            f"{gpus} GPUs x {gmis} GMIs x {8192 // gmis}",
            f"env=ant num_envs={8192 // gmis} num_timesteps={40 * 16 * 8192 * gpus} "
            f"plan.gpus={gpus} plan.gmis_per_gpu={gmis} "
            f"reduce.strategy={strategy if gpus * gmis > 1 else 'auto'} "
            f"{_NO_RATES} {_NO_CHECKPOINTS}",
            gpus,
        )
        for gmis, strategy in ways
        for gpus in (1, 2, 4, 8)
    )


def _long(name: str, gpus: int, num_envs: int, overrides: str = "") -> Case:
    """100M steps of ant, with one agent on each GPU unless `overrides` say otherwise."""
    own = f"env=ant physics.impl=warp num_timesteps=100e6 {_NO_RATES} num_envs={num_envs}"
    return _case(name, f"{own} {overrides}", gpus)


_GO1 = (
    "env=playground env.name=Go1JoystickFlatTerrain tuned=locomotion_ppo num_timesteps=100e6 "
    f"eval.every=10e6 seed={{run}} {_NO_RATES}"
)
_CARTPOLE = (
    "env=playground env.name=CartpoleBalance tuned=dm_control_ppo eval.every=6e6 seed={run} "
    f"{_NO_RATES}"
)
_A3C = "algo=a3c plan.backend=mps channel.capacity_mib=256"
_ON_ONE = "channel.transport=device plan.serving_gmis_per_gpu=2"
_ONE_EACH, _SEVERAL = "one process each", "4 agents + 2 trainers"

SUITES = MappingProxyType(
    {
        # Every task: one process against several GMIs, each with as many environments as it takes.
        "plans": tuple(_plan(task, *plan) for plan in PLANS for task in TASKS),
        # Playground's own settings; Go1 for half of its steps, by both kinds of value function.
        "playground": (
            _case("Go1JoystickFlatTerrain", _GO1),
            _case("Go1JoystickFlatTerrain, symmetric", f"{_GO1} algo.value_obs_key=state"),
            _case("CartpoleBalance", _CARTPOLE),
        ),
        # Long enough that whole runs can be compared.
        "async-long": (
            _long("1 GPU, synchronous", 1, 8192),
            _long("1 GPU, 2 agents + 1 trainer", 1, 4096, f"{_A3C} {_ON_ONE}"),
            _long("2 GPUs, synchronous", 2, 8192, "plan.gpus=2"),
            _long(f"1 + 1 GPUs, {_ONE_EACH}", 2, 8192, f"{_A3C} {_on('1', '1', 1, 1)}"),
            _long(f"1 + 1 GPUs, {_SEVERAL}", 2, 2048, f"{_A3C} {_on('1', '1', 4, 2)}"),
        ),
        # Acting and learning on one GPU, with the same 8192 environments as in one GMI.
        "async-1gpu": (
            _case("sync, 1 GMI x 8192", f"{_THIRTY} num_envs=8192"),
            _async("1 agent x 8192 + 1 trainer", 1, 8192),
            _async("2 agents x 4096 + 1 trainer", 1, 4096, "plan.serving_gmis_per_gpu=2"),
            _async("4 agents x 2048 + 1 trainer", 1, 2048, "plan.serving_gmis_per_gpu=4"),
        ),
        # One process a GPU against several, and against GPUs that do both.
        "async-2gpu": (
            _async(f"1 + 1 GPUs, {_ONE_EACH}", 2, 8192, _on("1", "1", 1, 1)),
            _async(f"1 + 1 GPUs, {_SEVERAL}", 2, 2048, _on("1", "1", 4, 2)),
            _async("2 GPUs, each 3 agents + 1 trainer", 2, 2048, _on("[0,1]", "[0,1]", 3, 1)),
        ),
        "async-4gpu": (
            _async(f"3 + 1 GPUs, {_ONE_EACH}", 4, 8192, _on("3", "1", 1, 1)),
            _async(f"3 + 1 GPUs, {_SEVERAL}", 4, 2048, _on("3", "1", 4, 2)),
            _async(
                *(f"3 + 1 GPUs, {_SEVERAL}, har, batches of 4 agents", 4, 2048),
                f"{_on('3', '1', 4, 2)} algo.batch_size=8192 reduce.strategy=har",
            ),
            _async(
                *("4 GPUs, each 3 agents + 1 trainer", 4, 2048),
                _on("[0,1,2,3]", "[0,1,2,3]", 3, 1),
            ),
        ),
        "async-channels": (
            *_channel_designs("ant", 4096),
            *_channel_designs("anymal", 2048),
            *_channel_designs("humanoid", 2048),
        ),
        # The same 8192 environments on one GPU: together, and in four GMIs.
        "ant-1gpu": (
            _case("1 GMI x 8192", f"{_THIRTY} num_envs=8192"),
            *_shared(1, 4, _THIRTY),
        ),
        # Trainers among their simulators, and in GMIs of their own.
        **{f"templates-{task}": _templates(task) for task in ("ant", "humanoid")},
        "ant-2gpu": _shared(2, 2, f"{_THIRTY} plan.gpus=2 {_NO_RATES}"),
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
        **{
            f"learn-{task}": (_case(task, f"env={task} seed={{run}} {own} {_NO_RATES}"),)
            for task, own in _LEARNING.items()
        },
        # Gradients through host memory against the paper's choice, and without the host.
        **{f"lgr-{task}": _lgr(task) for task in ("ant", "humanoid", "shadow_hand")},
        **{
            f"lgr-{task}-one_shot": _lgr(task, "mpr", "one_shot")
            for task in ("ant", "humanoid", "shadow_hand")
        },
        "scaling": _scaling((1, "flat"), (2, "har")),
        "scaling-one_shot": _scaling((1, "one_shot"), (2, "one_shot")),
    }
)
"""Suite -> cases. Ratios are taken within a suite, whose cases run in turn."""

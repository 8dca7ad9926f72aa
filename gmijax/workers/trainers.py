"""Parts of the mains of training jobs: input, environments, the reducer among trainers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.partition.plan import Plan
from gmijax.partition.templates import Group
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ChildLink

if TYPE_CHECKING:
    from gmijax.collectives.interface import Reducer
    from gmijax.collectives.ring import World
    from gmijax.sim.wrappers import BatchedEnv


def read_job(link: ChildLink) -> tuple[TrainConfig, Plan]:
    """Configuration and plan of this run."""
    config = from_dict(TrainConfig, read_json(link.run.config))
    return config, Plan.from_dict(read_json(link.run.plan))


def environments_of(config: TrainConfig, place: int) -> BatchedEnv:
    """The environments of the GMI that is number `place` of those that simulate."""
    from gmijax.sim.build import make_training_env

    return make_training_env(
        config.env,
        config.physics.impl,
        seed=config.seed,
        first_env=place * config.envs_per_gmi,
        num_envs=config.envs_per_gmi,
        random_ep_len=config.algo.init_at_random_ep_len,
    )


def join_trainers(
    config: TrainConfig, plan: Plan, trainers: Group, link: ChildLink
) -> World | None:
    """The trainers' processes as one, where their gradients go in rings; else None.

    Comes before all other use of jax. Raises as `join_world`.
    """
    from gmijax.collectives.build import join_world

    rank, timeout_s = trainers.gmis.index(link.gmi), config.run.start_timeout_s
    return join_world(plan.strategy, trainers.layout, rank, link.rendezvous, timeout_s)


def trainers_reducer(
    config: TrainConfig,
    plan: Plan,
    trainers: Group,
    link: ChildLink,
    num_floats: int,
    world: World | None,
) -> Reducer:
    """The reducer among the trainers, whose ranks are their places in the group.

    Its buffers for `mean` have `num_floats` numbers; `world` is from `join_trainers`. Raises as
    `build_reducer`.
    """
    from gmijax.collectives.build import Membership, build_reducer

    membership = Membership(
        layout=trainers.layout,
        rank=trainers.gmis.index(link.gmi),
        num_floats=num_floats,
        exchange_fd=link.exchange_fd,
        timeout_s=config.reduce.timeout_s,
        rendezvous_timeout_s=config.run.start_timeout_s,
        world=world,
        intra=plan.intra,
        # Whoever asks for it by name is told that it does not work.
        host_if_unavailable=config.reduce.intra == "auto" and config.reduce.strategy != "one_shot",
    )
    return build_reducer(plan.strategy, membership)


def exchange_used(plan: Plan, reducer: Reducer) -> dict[str, str]:
    """For the summary: the exchange in use, where it may differ from the plan's strategy."""
    on_device = reducer.is_device_resident
    if plan.strategy == "har":
        return {"intra": "ipc" if on_device else "host"}
    if plan.strategy == "one_shot" and not on_device:
        return {"strategy": "mpr", "intra": "host"}
    return {}

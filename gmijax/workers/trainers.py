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


def trainers_reducer(
    config: TrainConfig,
    plan: Plan,
    trainers: Group,
    link: ChildLink,
    num_floats: int,
) -> Reducer:
    """The reducer among the trainers, whose ranks are their places in the group.

    Means are of at most `num_floats` numbers. Raises as `build_reducer`.
    """
    from gmijax.collectives.build import Membership, build_reducer

    membership = Membership(
        layout=trainers.layout,
        rank=trainers.gmis.index(link.gmi),
        num_floats=num_floats,
        exchange_fd=link.exchange_fd,
        timeout_s=config.reduce.timeout_s,
        rendezvous_timeout_s=config.run.start_timeout_s,
        intra=plan.intra,
        # Whoever asks for it by name is told that it does not work.
        host_if_unavailable=config.reduce.intra == "auto" and config.reduce.strategy != "one_shot",
    )
    return build_reducer(plan.strategy, membership)


def exchange_used(plan: Plan, reducer: Reducer) -> dict[str, str]:
    """For the summary: the exchange in use, where it may differ from the plan's strategy."""
    if reducer.strategy != plan.strategy:
        return {"strategy": reducer.strategy, "intra": "host"}
    return {"intra": reducer.intra} if plan.strategy == "har" else {}

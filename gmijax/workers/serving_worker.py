"""Main of one serving GMI: `python -m gmijax.workers.serving_worker`.

Started by `gmijax.control.serving`. Reads the run folder, does what the plan gives
to this GMI, and writes `result.json`.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from gmijax.config import ServeConfig
from gmijax.config.schema import from_dict
from gmijax.partition.plan import Plan
from gmijax.partition.templates import AGENT, SIMULATOR, group_of, has_role
from gmijax.runs.dataset import DataPaths
from gmijax.runs.folder import read_json
from gmijax.supervise.child import ChildLink, run_gmi

if TYPE_CHECKING:
    from gmijax.collection.programs import ActingPolicy
    from gmijax.collection.recording import ShardWriter
    from gmijax.collectives.interface import Communicator
    from gmijax.sim.interface import EnvSpec

_TEMPLATES: Final = MappingProxyType(
    {"tcg": "gmijax.collection.collectors", "tdg": "gmijax.baselines.tdg"}
)
"""Modules whose `collect` does the part of a GMI, by `plan.template`."""


def _run(link: ChildLink) -> dict[str, Any]:
    link.keep_garbage()
    config = from_dict(ServeConfig, read_json(link.run.config))
    plan = Plan.from_dict(read_json(link.run.plan))
    roles = plan.roles[link.gmi]
    own = SIMULATOR if has_role(roles, SIMULATOR) else AGENT
    group = group_of(plan.layout, plan.roles, own)
    assert group is not None
    rank = group.gmis.index(link.gmi)
    # jax starts here, in the environment that the plan prepared.
    import numpy as np

    from gmijax.collection.collectors import CollectorContext
    from gmijax.devices import describe_device
    from gmijax.learning.start import envs_of
    from gmijax.selfcheck import check_share
    from gmijax.sim.wrappers import training_env

    check_share(plan, link.gmi)
    env = training_env(envs_of(config, rank))
    policy = _policy(config, env.spec)
    first, num_unrolls = _unrolls(config, rank, len(group.gmis)) if own == SIMULATOR else (0, 0)
    with ExitStack() as held:
        comm = _communicator(config, plan, link)
        held.callback(comm.close)
        writer = None
        if own == SIMULATOR and config.output.dir is not None:
            writer = _writer(config, rank, first, policy)
            held.callback(writer.close)
        context = CollectorContext(
            *(config, link, env, policy, rank, first, num_unrolls, writer),
            barrier=lambda: comm.all_gather(np.zeros(1, np.float32)),
        )
        # The template decides where what this GMI does is written.
        result = import_module(_TEMPLATES[plan.template]).collect(context, plan)
    written = {} if writer is None else {"shards": writer.num_written, "bytes": writer.num_bytes}
    return {
        **{"roles": roles, "policy_digest": policy.digest, "device": describe_device()},
        **{"first_unroll": first, "written": written},
        **result,
    }


def _policy(config: ServeConfig, spec: EnvSpec) -> ActingPolicy:
    from gmijax.collection.programs import random_policy, trained_policy

    if config.policy == "random":
        return random_policy(spec)
    return trained_policy(Path(str(config.run.dir)), spec, deterministic=config.deterministic)


def _unrolls(config: ServeConfig, rank: int, num_simulators: int) -> tuple[int, int]:
    """How many unrolls of GMI `rank` are there already, and how many are left."""
    wanted = config.unrolls_per_gmi(num_simulators)
    if config.output.dir is None:
        return 0, wanted
    first = DataPaths(Path(config.output.dir)).num_finished(rank)
    return first, max(0, wanted - first)


def _writer(config: ServeConfig, rank: int, first: int, policy: ActingPolicy) -> ShardWriter:
    from gmijax.collection.recording import ShardWriter

    about = {
        "env": config.env.label,
        "seed": config.seed,
        "first_env": rank * config.envs_per_gmi,
        "num_envs": config.envs_per_gmi,
        "first_unroll_of_job": first,
        "policy": policy.digest,
        "deterministic": config.deterministic,
    }
    paths = DataPaths(Path(str(config.output.dir)))
    return ShardWriter(paths, rank, first, about)


def _communicator(config: ServeConfig, plan: Plan, link: ChildLink) -> Communicator:
    """Serves as a barrier of all GMIs; it needs no gradients."""
    from gmijax.collectives.communicator import CommunicatorConfig, make_communicator

    return make_communicator(
        "mpr" if plan.layout.num_gmis > 1 else "none",
        CommunicatorConfig(
            layout=plan.layout,
            rank=link.gmi,
            num_floats=1,
            exchange_fd=link.exchange_fd,
            timeout_s=config.run.exchange_timeout_s,
            rendezvous_timeout_s=config.run.start_timeout_s,
            intra="host",
        ),
    )


if __name__ == "__main__":
    sys.exit(run_gmi(_run))

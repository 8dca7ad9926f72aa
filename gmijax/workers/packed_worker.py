"""Main of a GMI that makes several runs in one program: `gmijax.workers.packed_worker`.

Started by the supervisor only. `MEMBERS_VARIABLE` names their run folders.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.partition.plan import Plan
from gmijax.runs.folder import RunPaths, read_json
from gmijax.supervise.child import ChildLink, run_gmi
from gmijax.supervise.job_kinds import MEMBERS_VARIABLE


def main() -> int:
    """Runs this process's GMI; returns the exit code."""
    return run_gmi(_run)


def _run(link: ChildLink) -> None:
    link.keep_garbage()
    runs = [RunPaths(Path(root)) for root in json.loads(os.environ[MEMBERS_VARIABLE])]
    configs = [from_dict(TrainConfig, read_json(run.config)) for run in runs]
    # jax starts here, in the environment that the plan prepared.
    from gmijax.collectives.communicator import SingleRankCommunicator
    from gmijax.devices import start_device
    from gmijax.learning.algorithm import iterate_all, load_algorithm
    from gmijax.learning.loop import TrainingLoop
    from gmijax.learning.member import Member, Members
    from gmijax.selfcheck import check_share
    from gmijax.workers.training_worker import environments

    start_device()
    check_share(Plan.from_dict(read_json(link.run.plan)), link.gmi)
    first = configs[0]
    env = environments(replace(first, num_envs=len(runs) * first.num_envs), 0)
    pairs = zip(configs, runs, strict=True)
    members = Members([Member(config, run) for config, run in pairs], link.gmi)
    algorithm, comm = load_algorithm(first.algo), SingleRankCommunicator()
    learner = algorithm.make_learner(env.spec, first.algo)
    iteration = comm.program(partial(iterate_all, algorithm.iterate, env, learner))
    TrainingLoop(members, algorithm, learner, env, iteration, comm, link).run()


if __name__ == "__main__":
    sys.exit(main())

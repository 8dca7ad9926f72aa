"""The controller of `gmijax.search`: a search by itself, without the job."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from gmijax.autotune.tuner import Search, SearchResult, is_auto, workload_of
from gmijax.config import TrainConfig
from gmijax.config.schema import require_config, to_dict
from gmijax.control.console import Show, nearby, open_console, print_next
from gmijax.control.decide import with_task
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.runs.folder import create_run, write_json


def search(
    config: TrainConfig, *, show: Show = False, overrides: Sequence[str] = ()
) -> SearchResult:
    """Finds environments per GMI and GMIs per GPU for a training job, where they are `auto`.

    Args:
      config: see `gmijax.compose(..., command="search")`; its `search` has the settings.
      show: print progress, a table and the answer.
      overrides: `key=value` from which `config` was made, for the command that is printed last.

    Raises:
      ConfigError: bad input, before anything was started, or a budget too small for one profile.
      GmijaxError: no point can run.
      JobInterrupted: SIGINT, SIGTERM, SIGHUP or SIGUSR1 came; the profiles so far are kept.
    """
    require_config(config, TrainConfig)
    if config.run.resume is not None:
        raise ConfigError(
            f"run.resume={config.run.resume}: not for a search, which continues by itself from "
            "what search.store has"
        )
    if not is_auto(config):
        raise ConfigError(
            f"num_envs={config.num_envs}, plan.gmis_per_gpu={config.plan.gmis_per_gpu}: nothing "
            "to search for; make one of them auto"
        )
    config = with_task(config)
    console = open_console(show=show)
    started = Search(workload_of(config), detect_machine(), console)
    # After everything else was checked: nothing is left of a search that was refused.
    started.run = create_run(config.run.dir, config.run.name, f"{config.env.slug}-search")
    write_json(started.run.config, to_dict(config))
    console.print(f"run folder: {nearby(started.run.root)}")
    result = started.result()
    print_next(console, ("train with these numbers", following(config, overrides, result)))
    return result


def following(config: TrainConfig, overrides: Sequence[str], result: SearchResult) -> str:
    """The command that trains with what was found, beside what else was given."""
    given = overrides or (config.env.words, f"algo={config.algo.name}")
    left_out = ["run.dir=", "run.name=", "num_envs=", "plan.gmis_per_gpu="]
    if result.trainers or result.split is not None:
        # The job finds how GMIs and GPUs are divided where the search has left it.
        answers = ["num_envs=auto", "plan.gmis_per_gpu=auto"]
    else:
        left_out += ["search.", "physics.impl="]
        answers = [
            *(f"num_envs={result.num_envs}", f"plan.gmis_per_gpu={result.gmis_per_gpu}"),
            f"physics.impl={result.impl}",
        ]
    others = [word for word in given if not word.startswith(tuple(left_out))]
    return shlex.join(["gmijax", "train", *others, *answers])

"""What `gmijax.view` does: from a checkpoint to a page that shows its policy live. No jax here.

All in this process: beside a training it takes a fraction of a core, and nothing of a GPU.
"""

from __future__ import annotations

import queue
import socket
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

from rich.console import Console

from gmijax.config import EnvConfig, ViewConfig
from gmijax.control.console import doing, nearby, open_console
from gmijax.deploy.shipped import SHIPPED
from gmijax.deploy.trained_run import open_run
from gmijax.errors import ConfigError, NoCheckpointYet
from gmijax.player.plain_env import PlainEnv, task_of
from gmijax.player.policy import PlainPolicy, checkpoint_policy
from gmijax.player.shipped import require_alone, require_shipped, shipped_policy
from gmijax.runs.folder import RunPaths
from gmijax.runs.saved_config import config_of_run, task_and_algorithm
from gmijax.sim.registry import require_own
from gmijax.viewer.checkpoints import Checkpoints
from gmijax.viewer.guard import Guard, is_loopback
from gmijax.viewer.installed import INSTALL, missing
from gmijax.viewer.requests import Request
from gmijax.viewer.simulation import Simulation

_POLL_S: Final = 0.5


def view(config: ViewConfig, *, show: bool = False) -> None:
    """Shows a policy in the browser until the process is interrupted.

    Args:
      config: what to show; see `python -m gmijax.view --help`.
      show: print the address of the page.

    Raises:
      ConfigError: bad input, e.g. no such checkpoint, or a package that is not installed.
    """
    console = open_console(show=show)
    shown = _shipped(config) if config.checkpoint == SHIPPED else _of_run(config, console)
    envs = [PlainEnv(shown.env, seed=config.seed + number) for number in range(config.num_envs)]
    _require_fit(shown.policy, envs[0])
    require_packages()
    simulation = Simulation(envs, shown.policy, config.seed)
    _serve(config, simulation, shown, console)


class _Shown(NamedTuple):
    env: EnvConfig
    policy: PlainPolicy
    checkpoint: Path | None  # None: of no run.
    follow: bool  # Whether newer checkpoints are taken.
    lines: tuple[str, ...]  # What the user should know.


def _shipped(config: ViewConfig) -> _Shown:
    """The policy that comes with gmijax."""
    require_alone("run.dir", config.run.dir)
    task = require_shipped(config.run.env)
    policy = shipped_policy(task)
    lines = (f"the policy of {task} that comes with gmijax",)
    return _Shown(task_of(policy), policy, None, False, lines)


def _of_run(config: ViewConfig, console: Console) -> _Shown:
    """The policy of a checkpoint of a run."""
    follow = config.checkpoint is None
    config, env, changed = opened_once_saved(config, console)
    checkpoint = Path(str(config.checkpoint))
    lines = (f"checkpoint: {nearby(checkpoint)}", *filter(None, (changed,)))
    return _Shown(env, checkpoint_policy(checkpoint), checkpoint, follow, lines)


def opened_once_saved(
    config: ViewConfig, console: Console
) -> tuple[ViewConfig, EnvConfig, str | None]:
    """As `open_run`; waits for the first checkpoint of a run that is being trained."""
    with ExitStack() as waiting:
        is_waiting = False
        while True:
            try:
                return open_run(config)
            except NoCheckpointYet as error:
                if not is_waiting:
                    require_packages()  # Rather now than after the wait.
                    # It is being trained, so it has a configuration.
                    run = RunPaths(error.run)
                    env, _ = task_and_algorithm(config_of_run(run), run)
                    require_own(env)
                    waiting.enter_context(doing(console, f"waiting: {error}"))
                is_waiting = True
            time.sleep(_POLL_S)


def _require_fit(policy: PlainPolicy, env: PlainEnv) -> None:
    spec = env.spec
    wanted = spec.actor_obs_size or spec.obs_size, spec.action_size
    if (policy.obs_size, policy.action_size) != wanted:
        raise ConfigError(
            f"the policy takes {policy.obs_size} numbers and gives {policy.action_size}; "
            f"{spec.name} has {wanted[0]} and {wanted[1]}"
        )


def require_packages() -> None:
    """Raises ConfigError if a package of the viewer is not installed."""
    if absent := missing():
        raise ConfigError(f"gmijax view needs {' and '.join(absent)} ({INSTALL})")


def _serve(config: ViewConfig, simulation: Simulation, shown: _Shown, console: Console) -> None:
    from gmijax.viewer.browser_page import BrowserPage
    from gmijax.viewer.loop import Loop
    from gmijax.viewer.server import close_server, open_server

    run = None if shown.checkpoint is None else Checkpoints(shown.checkpoint.parents[1])
    server = open_server(Guard(config.view.host, config.view.allow_origin), config.view.port)
    try:
        asked: queue.SimpleQueue[Request] = queue.SimpleQueue()
        title = shown.env.label
        page = BrowserPage(server, asked, title, simulation, has_run=run is not None)
        for line in (*shown.lines, *_about(config, server.url, server.get_port())):
            console.print(line)
        Loop(
            simulation,
            page,
            asked,
            run=run,
            checkpoint=shown.checkpoint,
            follow_training=shown.follow,
        ).run()
    finally:
        close_server(server)


def _about(config: ViewConfig, url: str, port: int) -> list[str]:
    """Where the page is, and how to reach it from elsewhere."""
    taken = config.view.port not in (0, port)
    lines = [f"view.port={config.view.port} is taken; this is {port}"] if taken else []
    if is_loopback(config.view.host):
        here = socket.gethostname()
        there = f"[{config.view.host}]" if ":" in config.view.host else "127.0.0.1"
        hint = f"from another machine: ssh -L {port}:{there}:{port} {here}, then the same address"
    else:
        hint = "whoever has this address can open the page and press its buttons"
    return [*lines, url, f"{hint}; Ctrl-C ends it"]

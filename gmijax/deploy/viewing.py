"""What `gmijax.view` does: from a checkpoint to a page that shows its policy live. No jax here.

All in this process: beside a training it takes a fraction of a core, and nothing of a GPU.
"""

from __future__ import annotations

import os
import queue
from pathlib import Path

from rich.console import Console

from gmijax.config import ViewConfig
from gmijax.control.console import nearby, open_console
from gmijax.deploy.playing import open_run
from gmijax.errors import ConfigError
from gmijax.player.plain_env import PlainEnv
from gmijax.player.policy import PlainPolicy, read_policy
from gmijax.runs.folder import POLICY
from gmijax.viewer.checkpoints import Checkpoints
from gmijax.viewer.guard import Guard, is_loopback
from gmijax.viewer.installed import INSTALL, missing
from gmijax.viewer.requests import Request
from gmijax.viewer.simulation import Simulation

def view(config: ViewConfig, *, show: bool = False) -> None:
    """Shows a policy in the browser until the process is interrupted.

    Args:
      config: what to show; see `python -m gmijax.view --help`.
      show: print the address of the page.

    Raises:
      ConfigError: bad input, e.g. no such checkpoint, or a package that is not installed.
    """
    follow = config.checkpoint is None
    config, env, changed = open_run(config)
    checkpoint = Path(str(config.checkpoint))
    policy = _policy(checkpoint)
    envs = [PlainEnv(env, seed=config.seed + number) for number in range(config.num_envs)]
    _require_fit(policy, envs[0], checkpoint)
    console = open_console(show=show)
    console.print(f"checkpoint: {nearby(checkpoint)}")
    if changed:
        console.print(changed)
    _require_packages()
    _serve(config, Simulation(envs, policy, config.seed), env.label, checkpoint, follow, console)


def _policy(checkpoint: Path) -> PlainPolicy:
    if not os.path.lexists(checkpoint / POLICY):
        raise ConfigError(
            f"checkpoint {checkpoint}: has no {POLICY}, an older version of gmijax wrote it; "
            "gmijax play can play it"
        )
    return read_policy(checkpoint / POLICY)


def _require_fit(policy: PlainPolicy, env: PlainEnv, checkpoint: Path) -> None:
    sizes = policy.obs_size, policy.action_size
    if sizes != (env.spec.actor_obs_size or env.spec.obs_size, env.spec.action_size):
        raise ConfigError(
            f"checkpoint {checkpoint}: its policy takes {sizes[0]} numbers and gives {sizes[1]}; "
            f"{env.spec.name} has {env.spec.obs_size} and {env.spec.action_size}"
        )


def _require_packages() -> None:
    if absent := missing():
        raise ConfigError(f"gmijax view needs {' and '.join(absent)} ({INSTALL})")


def _serve(
    config: ViewConfig,
    simulation: Simulation,
    title: str,
    checkpoint: Path,
    follow: bool,
    console: Console,
) -> None:
    from gmijax.viewer.browser_page import BrowserPage
    from gmijax.viewer.loop import Loop
    from gmijax.viewer.server import close_server, open_server

    server = open_server(Guard(config.view.host, config.view.allow_origin), config.view.port)
    try:
        asked: queue.SimpleQueue[Request] = queue.SimpleQueue()
        page = BrowserPage(server, asked, title, simulation, has_run=True)
        loop = Loop(
            simulation,
            page,
            asked,
            run=Checkpoints(checkpoint.parents[1]),
            checkpoint=checkpoint,
            follow_training=follow,
        )
        for line in _about(config, server.url, server.get_port()):
            console.print(line)
        loop.run()
    finally:
        close_server(server)


def _about(config: ViewConfig, url: str, port: int) -> list[str]:
    """Where the page is, and how to reach it from elsewhere."""
    lines = []
    if config.view.port not in (0, port):
        lines.append(f"view.port={config.view.port} is taken; this is {port}")
    if is_loopback(config.view.host):
        lines.append(f"from another machine: ssh -L {port}:localhost:{port} this machine, then")
    else:
        lines.append("anybody who has this address can open the page:")
    return [*lines, url, "Ctrl-C ends it"]

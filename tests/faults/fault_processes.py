"""The processes of a command: which is which, and what can be done to them."""

from __future__ import annotations

import os
import random
import re
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

MARKER = "GMIJAX_FAULTS"
"""Names the folder of a case in the environment of all its processes."""

SUSPENDED_S = 15.0
STALL = ("reduce.timeout_s=6", "run.stall_timeout_s=10")
"""A suspended process does nothing for longer than these; a trainer of a toy task never does."""

_ROLES = {
    "gmijax.supervise.janitor": "janitor",
    "gmijax.workers.training_job": "job",
    "gmijax.workers.film_writer": "film",
    "gmijax.workers.wandb_writer": "wandb",
}


class Process(NamedTuple):
    """One process of a command.

    Attributes:
      pid: its number.
      role: `controller`, `job` (the controller of a job of a sweep), `janitor`, `gmi_<id>`, ...
    """

    pid: int
    role: str


def processes_of(scratch: Path, controller: int | None = None) -> list[Process]:
    """The processes that carry the marker of a case; no zombies."""
    marker = f"{MARKER}={scratch}"
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            variables = (entry / "environ").read_bytes().decode(errors="replace").split("\0")
            words = (entry / "cmdline").read_bytes().decode(errors="replace")
        except OSError:
            continue
        if marker in variables:
            known = dict(item.split("=", 1) for item in variables if "=" in item)
            found.append(_process(int(entry.name), words, known, controller))
    return found


def _process(pid: int, words: str, known: dict[str, str], controller: int | None) -> Process:
    role = next((role for module, role in _ROLES.items() if module in words), "other")
    if pid == controller:
        role = "controller"
    elif role == "other" and "GMIJAX_GMI" in known:
        role = f"gmi_{known['GMIJAX_GMI']}"
    return Process(pid, role)


def gmis_of(processes: Sequence[Process]) -> list[Process]:
    """Those that are GMIs."""
    return [process for process in processes if process.role.startswith("gmi_")]


def chosen(processes: Sequence[Process], whom: str, draw: random.Random) -> list[Process]:
    """The processes that are meant: `all`, `gmis`, `gmi` (any one) or a role; one of several."""
    if whom == "all":
        return list(processes)
    if whom in ("gmis", "gmi"):
        found = gmis_of(processes)
    else:
        found = [process for process in processes if re.fullmatch(whom, process.role)]
    found = sorted(found, key=lambda process: process.role)
    return found if whom == "gmis" or not found else [draw.choice(found)]


def send(processes: Sequence[Process], number: signal.Signals) -> None:
    """Sends a signal to each; some may just have ended by themselves."""
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process.pid, number)


def suspend(processes: Sequence[Process], seconds: float = SUSPENDED_S) -> None:
    """Stops all of them, and has them go on later, as a scheduler or a closed lid does.

    Whoever watches another is stopped first and goes on first: it must not take the others for
    hung, before or after.
    """
    watchers_first = sorted(processes, key=lambda process: process.role.startswith("gmi_"))
    send(watchers_first, signal.SIGSTOP)
    try:
        time.sleep(seconds)
    finally:
        send(watchers_first, signal.SIGCONT)

"""Moments in the life of a command, and what is done to it then, from outside."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from fault_commands import COMMANDS, steps_saved
from fault_processes import Process, chosen, gmis_of, processes_of, send, suspend

MOVED = "moved"
"""What a run folder is called that was moved away."""

_MOST_INODES = 1 << 15


class Running(Protocol):
    """A command that runs: what moments and acts need of it."""

    scratch: Path
    run: Path
    command: str
    disk: str
    draw: random.Random
    pid: int
    progress_before: int

    def progress(self) -> int:
        """What it has finished."""
        ...


def _processes(job: Running) -> list[Process]:
    return processes_of(job.scratch, job.pid)


def _has_child(job: Running) -> bool:
    return any(process.role not in ("controller", "janitor") for process in _processes(job))


def _has_gmi(job: Running) -> bool:
    return bool(gmis_of(_processes(job)))


def _has_saved(job: Running) -> bool:
    if not COMMANDS[job.command].is_endless and job.command != "sweep":
        return _has_gmi(job)
    return job.progress() > job.progress_before and _has_gmi(job)


def _has_trained(job: Running) -> bool:
    wanted = next(
        key.partition("=")[2]
        for key in COMMANDS[job.command].overrides
        if key.startswith("num_timesteps=")
    )
    return steps_saved(job.run) == int(wanted)


def _has_ended(job: Running) -> bool:
    return (job.run / "gmi_0" / "result.json").exists() and not _has_gmi(job)


MOMENTS: Mapping[str, Callable[[Running], bool]] = MappingProxyType(
    {
        "begun": _has_child,
        "any": _has_gmi,  # And then a random while.
        "saved": _has_saved,
        "trained": _has_trained,
        "ended": _has_ended,
        "filming": lambda job: any(p.role == "film" for p in _processes(job)),
    }
)


def _send_to(job: Running, whom: str, number: signal.Signals) -> None:
    send(chosen(_processes(job), whom, job.draw), number)


def _term_and_suspend(job: Running, whom: str) -> None:
    _send_to(job, "controller", signal.SIGTERM)
    time.sleep(job.draw.uniform(0.0, 0.1))
    suspend(chosen(_processes(job), whom, job.draw))


def _term_twice(job: Running, whom: str) -> None:
    _send_to(job, whom, signal.SIGTERM)
    time.sleep(1.5)
    _send_to(job, whom, signal.SIGTERM)


def _stop_and_kill(job: Running, whom: str) -> None:
    """The janitor and a GMI cannot act when the controller is killed."""
    processes = _processes(job)
    for stopped in ("janitor", "gmi"):
        send(chosen(processes, stopped, job.draw), signal.SIGSTOP)
    send(chosen(processes, whom, job.draw), signal.SIGKILL)


def _move(job: Running, _: str) -> None:
    job.run.rename(job.run.with_name(MOVED))


def _move_parent(job: Running, _: str) -> None:
    job.run.parent.rename(job.run.parent.with_name(MOVED))


def _replace(job: Running, _: str) -> None:
    """Another folder takes its place, with all that it had: a backup that was put back."""
    moved = job.run.with_name(MOVED)
    shutil.copytree(job.run, job.run.with_name("copy"), ignore_dangling_symlinks=True)
    job.run.rename(moved)
    job.run.with_name("copy").rename(job.run)


def _remove(job: Running, _: str) -> None:
    while job.run.exists():  # Files may appear meanwhile.
        shutil.rmtree(job.run, ignore_errors=True)


def _read_only(job: Running, _: str) -> None:
    options = ["-o", "bind,ro"]
    subprocess.run(["mount", *options, str(job.run), str(job.run)], check=True)


def _fill(job: Running, _: str) -> None:
    fill(job.run.parent / "filler", job.disk)


def _fill_cache(job: Running, whom: str) -> None:
    """And has the programs compiled again."""
    cache = job.scratch / "cache"
    for path in cache.iterdir():
        path.unlink()
    fill(cache / "filler", job.disk)
    _send_to(job, whom, signal.SIGKILL)


ACTS: Mapping[str, Callable[[Running, str], None]] = MappingProxyType(
    {
        "nothing": lambda job, whom: None,
        "kill": lambda job, whom: _send_to(job, whom, signal.SIGKILL),
        "stop": lambda job, whom: _send_to(job, whom, signal.SIGSTOP),
        "term": lambda job, whom: _send_to(job, whom, signal.SIGTERM),
        "suspend": lambda job, whom: suspend(chosen(_processes(job), whom, job.draw)),
        "term_and_suspend": _term_and_suspend,
        "term_twice": _term_twice,
        "stop_and_kill": _stop_and_kill,
        "move": _move,
        "move_parent": _move_parent,
        "replace": _replace,
        "remove": _remove,
        "read_only": _read_only,
        "fill": _fill,
        "fill_cache": _fill_cache,
    }
)


def fill(folder: Path, disk: str) -> None:
    """Fills a file system with what lies in `folder`: to its last byte, or to its last inode."""
    with suppress(OSError):
        folder.mkdir()
        for number in range(_MOST_INODES if "inodes" in disk else 0):
            os.close(os.open(folder / str(number), os.O_CREAT | os.O_WRONLY))
    for size in () if "inodes" in disk else (1 << 16, 1):
        with suppress(OSError), (folder / "bytes").open("ab", buffering=0) as file:
            while True:
                file.write(bytes(size))


def repair(job: Running, does: str) -> None:
    """Undoes what its owner would undo before he gives the command again."""
    moved = job.run.with_name(MOVED)
    if does == "read_only":
        subprocess.run(["umount", "--lazy", str(job.run)], check=True)
    elif does in ("fill", "fill_cache"):
        for folder in (job.run.parent, job.scratch / "cache"):
            shutil.rmtree(folder / "filler", ignore_errors=True)
    elif does in ("move", "replace") and moved.exists():
        shutil.rmtree(job.run, ignore_errors=True)
        moved.rename(job.run)
    elif does == "move_parent":
        shutil.rmtree(job.run.parent, ignore_errors=True)
        job.run.parent.with_name(MOVED).rename(job.run.parent)

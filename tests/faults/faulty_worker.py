"""Main of a training GMI that has faults at points of its work, each of them once.

`GMIJAX_FAULTS` names a folder: `plan.json` holds the faults, `fired_<number>` says that one has
come. Points are found by wrapping functions of the package, which knows nothing of this.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fault_plan import KINDS, Fault
from fault_processes import SUSPENDED_S, gmis_of, processes_of
from training_jobs import pids_of

from gmijax.supervise import child
from gmijax.supervise.child import ChildLink
from gmijax.workers import training_worker

SCRATCH = Path(os.environ["GMIJAX_FAULTS"])
SLOW_S = 1.0
_PACE_S = 0.02
"""Longest and least time of an iteration, so that a signal is handled before the next fault."""


class Injected(Exception):
    """What a fault raises."""


class Faults:
    """The faults that are left for this GMI."""

    def __init__(self) -> None:
        self._gmi = int(os.environ["GMIJAX_GMI"])
        self._run = Path(os.environ["GMIJAX_RUN_DIR"])
        self._plan = [Fault(*item) for item in json.loads((SCRATCH / "plan.json").read_text())]
        self._before = {path.name for path in SCRATCH.glob("fired_*")}
        self.iteration = 0

    def at(self, point: str) -> None:
        """Does what the plan has for this point, if it is time."""
        for number, fault in enumerate(self._plan):
            kind, fired = KINDS[fault.kind], SCRATCH / f"fired_{number}"
            is_due = self.iteration >= fault.iteration and fault.gmi == self._gmi
            if kind.point != point or not is_due or fired.exists() or self._is_ending():
                continue
            fired.touch()
            self._do(kind.does)

    def is_poisoned(self) -> bool:
        """Whether this GMI's environments are to be NaN."""
        flag = SCRATCH / "nan"
        return flag.exists() and flag.read_text() == str(self._gmi)

    def _is_ending(self) -> bool:
        """Whether this attempt has had a fault that ends it, which may take a moment."""
        now = {path.name for path in SCRATCH.glob("fired_*")}
        harmless = {
            f"fired_{number}"
            for number, fault in enumerate(self._plan)
            if KINDS[fault.kind].outcome == "nothing happened"
        }
        return bool(now - self._before - harmless)

    def _do(self, what: str) -> None:
        controller, own = os.getppid(), os.getpid()
        actions: dict[str, Callable[[], object]] = {
            "kill": lambda: os.kill(own, signal.SIGKILL),
            "stop": lambda: os.kill(own, signal.SIGSTOP),
            "slow": lambda: time.sleep(SLOW_S),
            "kill_controller": lambda: os.kill(controller, signal.SIGKILL),
            "kill_controller_and_stop": lambda: (
                os.kill(controller, signal.SIGKILL),
                os.kill(own, signal.SIGSTOP),
            ),
            "kill_janitor": lambda: os.kill(_janitor_of(controller), signal.SIGKILL),
            "suspend_job": lambda: _suspend([controller, *_gmis()]),
            "suspend_controller": lambda: _suspend([controller]),
            "suspend_janitor": lambda: _suspend([_janitor_of(controller)]),
            "suspend_gmis": lambda: _suspend(_gmis()),
            "usr1": lambda: os.kill(controller, signal.SIGUSR1),
            "hup": lambda: os.kill(controller, signal.SIGHUP),
            "term_all": lambda: [
                os.kill(pid, signal.SIGTERM) for pid in (controller, *pids_of(self._run))
            ],
            "nan": lambda: (SCRATCH / "nan").write_text(str(self._gmi)),
            "file_limit": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)),
            "fill_disk": lambda: _fill(self._run.parent / "filler"),
            "raise": _raise,
        }
        actions[what]()


def _janitor_of(controller: int) -> int:
    for entry in Path(f"/proc/{controller}/task/{controller}/children").read_text().split():
        if b"gmijax.supervise.janitor" in Path(f"/proc/{entry}/cmdline").read_bytes():
            return int(entry)
    raise LookupError("no janitor")


def _gmis() -> list[int]:
    return [process.pid for process in gmis_of(processes_of(SCRATCH))]


def _suspend(pids: list[int]) -> None:
    """Stops processes, this one perhaps too, and has them go on later: by one that is not."""
    script = 'kill -STOP "$@"; sleep "$0"; kill -CONT "$@" 2>/dev/null'
    others = {key: value for key, value in os.environ.items() if not key.startswith("GMIJAX_")}
    subprocess.Popen(
        ["sh", "-c", script, str(SUSPENDED_S), *map(str, pids)],
        env=others,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    time.sleep(2 * _PACE_S)


def _raise() -> None:
    raise Injected("a fault of the plan")


def _fill(path: Path) -> None:
    for size in (1 << 16, 1):  # To the last byte.
        try:
            with path.open("ab", buffering=0) as file:
                while True:
                    file.write(bytes(size))
        except OSError:
            continue


def _before(owner: Any, name: str, act: Callable[..., object]) -> None:
    """Has `act` called with the arguments of `owner.name`, before it."""
    inner = getattr(owner, name)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        act(*args)
        return inner(*args, **kwargs)

    setattr(owner, name, wrapped)


def _inject(faults: Faults) -> None:
    """Wraps what needs no jax; the rest when jax has been loaded."""
    inner, injected = ChildLink.beat, []

    def beat(self: ChildLink, state: Any, iteration: int) -> None:
        inner(self, state, iteration)
        if state == "compiling" and not injected:  # It comes again after waiting.
            injected.append(True)
            _inject_in_training(faults)
            faults.at("compiling")
        if state == "running":
            faults.iteration = iteration
            time.sleep(_PACE_S)
            faults.at("beat")

    ChildLink.beat = beat

    def written(path: Path, _: Any) -> None:
        if path.name == "result.json":
            faults.at("result")

    _before(child, "write_json", written)


def _inject_in_training(faults: Faults) -> None:
    import jax
    import jax.numpy as jnp

    from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
    from gmijax.collectives.program import ProgramStep
    from gmijax.learning import checkpoint, kept_checkpoints, saved_arrays
    from gmijax.learning.throughput import ThroughputMeter
    from gmijax.learning.training_log import TrainingLog

    def synced(path: Path) -> None:
        if path.name.endswith(".partial"):
            faults.at("rename")
        if path.name == "checkpoints":
            faults.at("named")

    def removed(path: Path, **_: Any) -> None:
        if path.name.endswith(".removed") and path.exists():
            faults.at("removing")

    save, iterate = saved_arrays.save, ProgramStep.__call__

    def save_half(folder: Path, tree: Any) -> None:
        save(folder, tree)
        largest = max(folder.rglob("*"), key=lambda path: path.is_file() and path.stat().st_size)
        whole = largest.read_bytes()
        largest.write_bytes(whole[: len(whole) // 2])
        faults.at("part")
        largest.write_bytes(whole)

    def nan(leaf: jax.Array) -> jax.Array:
        return leaf * jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    def iterate_poisoned(self: ProgramStep, shared: Any, own: Any) -> Any:
        if faults.is_poisoned():
            own = jax.tree.map(nan, own)
        return iterate(self, shared, own)

    _before(SharedMemoryGroup, "all_reduce", lambda *_: faults.at("mean"))
    _before(TrainingLog, "write", lambda *_: faults.at("report"))
    _before(ThroughputMeter, "measure", lambda *_: faults.at("measuring"))
    _before(checkpoint, "_sync", synced)
    saved_arrays.save = save_half
    kept_checkpoints.shutil = _Recorded(kept_checkpoints.shutil, removed)
    ProgramStep.__call__ = iterate_poisoned


class _Recorded:
    """`shutil` of one module, whose `rmtree` is announced."""

    def __init__(self, inner: Any, before: Callable[..., None]) -> None:
        self._inner = inner
        self._act = before

    def rmtree(self, path: Path, **options: Any) -> None:
        self._act(path)
        self._inner.rmtree(path, **options)


if __name__ == "__main__":
    faults = Faults()
    _inject(faults)
    faults.at("importing")
    sys.exit(training_worker.main())

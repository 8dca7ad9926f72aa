"""Jobs that have faults: started, given again until they are complete, and looked at after that.

What must be true then whatever the faults were is in `fault_checks`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import fault_checks
import numpy as np
from fault_plan import CHECKPOINT_EVERY, ITERATIONS, KINDS, Fault
from training_jobs import POINT, POINT_TASK, STEPS, child_environment, learner_arrays, wait_until

from gmijax.runs.history import read_metrics
from gmijax.runs.resume import newest_checkpoint

LIMIT_S = 120.0
"""Of what is waited for after a command; on an idle machine it takes seconds."""

_COMMAND_S = 600.0
"""Of a command with all its restarts, each of a few seconds on an idle machine."""

_DISK_MIB = 64
_HERE = Path(__file__).resolve().parent
_COMMAND = (
    *(*POINT[:-1], "plan.gpus=2", "plan.backend=cpu", "reduce.strategy=mpr"),
    *(f"num_timesteps={ITERATIONS * 2 * STEPS}", f"run.checkpoint_every={CHECKPOINT_EVERY}"),
    *("run.keep_checkpoints=3", "run.resume=auto"),
)
_SHORT = ("reduce.timeout_s=6", "run.stall_timeout_s=12")


class Came(NamedTuple):
    """A fault, and what became of it.

    Attributes:
      fault: of the plan.
      outcome: what the job came to, `unexpected: ...` if it should not have.
    """

    fault: Fault
    outcome: str


class Report(NamedTuple):
    """A job and its faults.

    Attributes:
      came: its faults.
      leaks: what it left.
      lost: checkpoints that it should have gone on from and did not.
      is_equal: whether it learnt what the undisturbed run did, bit by bit.
    """

    came: list[Came]
    leaks: list[str]
    lost: list[str]
    is_equal: bool

    @property
    def is_good(self) -> bool:
        """Whether everything was as it must be."""
        as_wanted = all(KINDS[x.fault.kind].outcome == x.outcome for x in self.came)
        return as_wanted and not self.leaks and not self.lost and self.is_equal


def undisturbed(cwd: Path) -> list[np.ndarray]:
    """What the job learns without faults."""
    report = _Job([], cwd).run([])
    assert report == [], report
    return learner_arrays(cwd / "disk" / "run")


def run_job(faults: Sequence[Fault], cwd: Path, expected: list[np.ndarray]) -> Report:
    """Runs a job with faults to its end in `cwd`, which is made; raises nothing."""
    job = _Job(faults, cwd)
    leaks = []
    with _disk(cwd / "disk", any(fault.kind == "disk_full" for fault in faults)):
        try:
            leaks = job.run(expected)
        except Exception as error:
            leaks = [f"{type(error).__name__}: {error}"]
            job.end()
        if leaks or job.wrong:
            big = shutil.ignore_patterns("filler")
            shutil.copytree(cwd / "disk", cwd / "kept", ignore=big, dirs_exist_ok=True)
    return Report(job.came(), leaks, job.lost, job.is_equal)


@cache
def can_mount() -> bool:
    """Whether this process may mount a file system of its own, and have commands do it."""
    if shutil.which("unshare") is None:
        return False
    tried = ["unshare", "-m", "mount", "-t", "tmpfs", "-o", "ro", "tmpfs", "/dev/shm"]
    return subprocess.run(tried, capture_output=True, check=False).returncode == 0


def kinds_here() -> list[str]:
    """The kinds of faults that can be made on this machine."""
    needs_mount = {"disk_full", "shm_unwritable"}
    return [kind for kind in KINDS if can_mount() or kind not in needs_mount]


@contextmanager
def _disk(folder: Path, is_small: bool) -> Iterator[None]:
    folder.mkdir(parents=True, exist_ok=True)
    if not is_small:
        yield
        return
    size = f"size={_DISK_MIB}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


class _Job:
    def __init__(self, faults: Sequence[Fault], cwd: Path) -> None:
        self.commands = 0
        self.is_equal = False
        self.lost: list[str] = []
        self.wrong: dict[int, str] = {}
        self._faults = list(faults)
        self._kinds = {fault.kind for fault in faults}
        self._cwd = cwd
        self._run = cwd / "disk" / "run"
        self._events_seen = 0
        for folder in (cwd, cwd / "tmp", cwd / "disk"):
            folder.mkdir(parents=True, exist_ok=True)
        (cwd / "point.py").write_text(POINT_TASK)
        (cwd / "plan.json").write_text(json.dumps(self._faults))

    def run(self, expected: list[np.ndarray]) -> list[str]:
        """Gives the command until it succeeds; returns what was left behind."""
        before = fault_checks.before()
        while self._give_command():
            assert self.commands < len(self._faults) + 3, "it does not end"
        left = fault_checks.what_is_left(before, self._run, self._cwd, LIMIT_S)
        wrong = fault_checks.what_is_wrong(self._run)
        found = learner_arrays(self._run)
        self.is_equal = len(found) == len(expected) and all(map(np.array_equal, found, expected))
        return [*left, *wrong]

    def came(self) -> list[Came]:
        """All faults with their outcomes."""
        fired, told = self._fired(), []
        for number, fault in enumerate(self._faults):
            kind = KINDS[fault.kind]
            outcome: str = kind.outcome
            if number not in fired and kind.place != "command":
                outcome = "unexpected: it did not come"
            told.append(Came(fault, self.wrong.get(number, outcome)))
        return told

    def end(self) -> None:
        """Ends what runs."""
        for pid in fault_checks.processes_of(self._cwd):
            with suppress(ProcessLookupError):
                os.kill(pid, 9)

    def _give_command(self) -> bool:
        """Starts or resumes the job and waits for its end; returns whether it must be resumed."""
        fired, newest = self._fired(), newest_checkpoint(self._run).checkpoint
        code = self._command()
        self.commands += 1
        now = [number for number in sorted(self._fired()) if number not in fired]
        wait_until(lambda: not fault_checks.processes_of(self._cwd), LIMIT_S, "all processes gone")
        self._judge(now, code, newest)
        for number in now:
            self._repair_or_damage(self._faults[number].kind)
        return code != 0

    def _command(self) -> int:
        overrides = (*_COMMAND, *(_SHORT if "stop" in self._kinds else ()))
        command = [sys.executable, "-m", "faulty_controller", *overrides, "run.dir=disk/run"]
        if "shm_unwritable" in self._kinds:
            script = 'mount -t tmpfs -o ro tmpfs /dev/shm && exec "$@"'
            command = ["unshare", "-m", "sh", "-c", script, "sh", *command]
        if "stdout_closed" in self._kinds:
            command = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
        is_gone = "stdout_gone" in self._kinds
        with (
            (self._cwd / f"stdout_{self.commands}.txt").open("wb") as out,
            (self._cwd / f"stderr_{self.commands}.txt").open("wb") as err,
            subprocess.Popen(
                command,
                cwd=self._cwd,
                env=self._environment(),
                stdout=subprocess.PIPE if is_gone else out,
                stderr=err,
                start_new_session=True,
            ) as job,
        ):
            if job.stdout is not None:
                job.stdout.close()
            try:
                return job.wait(_COMMAND_S)
            finally:
                job.kill()

    def _environment(self) -> dict[str, str]:
        own = {"GMIJAX_FAULTS": str(self._cwd), "TMPDIR": str(self._cwd / "tmp")}
        if "cache_truncated" in self._kinds:
            own["JAX_COMPILATION_CACHE_DIR"] = str(self._cwd / "cache")
        path = os.pathsep.join(map(str, (_HERE, _HERE.parent)))
        inherited = child_environment()
        return inherited | own | {"PYTHONPATH": f"{path}{os.pathsep}{inherited['PYTHONPATH']}"}

    def _fired(self) -> set[int]:
        return {int(path.name.removeprefix("fired_")) for path in self._cwd.glob("fired_*")}

    def _judge(self, now: Sequence[int], code: int, newest: Path | None) -> None:
        """Compares what a command came to with the faults that came while it ran."""
        kinds = {number: KINDS[self._faults[number].kind] for number in now}
        ending = [number for number in now if kinds[number].exit_code is not None]
        wanted = kinds[ending[-1]].exit_code if ending else 0
        events = self._new_events()
        starts = [event for event in events if event["event"] == "start"]
        faults = [event for event in events if event["event"] == "fault"]
        num_faults = sum(kind.outcome == "restarted" for kind in kinds.values())
        num_faults += sum(self._faults[number].kind == "nan" for number in now)
        # Nothing can be noted on a full disk.
        is_full = any(kind.does == "fill_disk" for kind in kinds.values())
        if code != wanted or (len(faults) != num_faults and not is_full):
            said = (self._cwd / f"stderr_{self.commands - 1}.txt").read_text()[-600:]
            text = f"unexpected: exit code {code}, {len(faults)} faults, {said}"
            # None came: then it is about how the command was started, or about the last one.
            for number in now or range(len(self._faults)):
                self.wrong[number] = text
        if starts and starts[0]["checkpoint"] != (newest and str(newest)):
            self.lost.append(f"went on from {starts[0]['checkpoint']}, not {newest}")
        for fault, start in zip(faults, starts[1:], strict=False):
            begun = int(Path(start["checkpoint"]).name) if start["checkpoint"] else 0
            # The metrics of an iteration are looked at while the next one runs; a checkpoint is
            # written while training goes on, and is there when the next one begins.
            if fault["iteration"] - begun // (2 * STEPS) > 2 * CHECKPOINT_EVERY + 1:
                self.lost.append(f"{fault} and then {start}")

    def _new_events(self) -> list[dict[str, Any]]:
        events = read_metrics(self._run / "events.jsonl")  # What is half written: `fault_checks`.
        new, self._events_seen = events[self._events_seen :], len(events)
        return new

    def _repair_or_damage(self, kind: str) -> None:
        """What happens between two commands."""
        if kind == "nan":
            (self._cwd / "nan").unlink()
        elif kind == "disk_full":
            (self._cwd / "disk" / "filler").unlink()
        elif kind == "cache_truncated":
            for entry in (self._cwd / "cache").glob("*-cache"):
                os.truncate(entry, entry.stat().st_size // 2)
        elif kind.startswith("checkpoint_"):
            _damage(newest_checkpoint(self._run).checkpoint, kind)


def _damage(checkpoint: Path | None, kind: str) -> None:
    assert checkpoint is not None, "there is none to damage"
    meta = checkpoint / "meta.json"
    files = [path for path in checkpoint.rglob("*") if path.is_file() and path != meta]
    largest = max(files, key=lambda path: path.stat().st_size)
    if kind == "checkpoint_meta":
        os.truncate(meta, 0)
    elif kind == "checkpoint_truncated":
        os.truncate(largest, largest.stat().st_size // 2)
    else:
        data = bytearray(largest.read_bytes())
        data[len(data) // 2] ^= 1
        largest.write_bytes(data)

"""Jobs that have faults: started, given again until they are complete, and looked at after that.

What must be true then whatever the faults were is in `fault_checks`.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fault_checks
import numpy as np
from fault_checks import events_of, newest_whole
from fault_damage import add_copies, copies_in, damage_checkpoint, damage_entries
from fault_disks import disk_of
from fault_plan import CHECKPOINT_EVERY, ITERATIONS, KINDS, Fault
from fault_processes import MARKER, STALL, processes_of, send
from fault_report import Came, Report
from training_jobs import POINT, POINT_TASK, STEPS, child_environment, learner_arrays, wait_until

LIMIT_S = 120.0
"""Of what is waited for after a command; on an idle machine it takes seconds."""

_COMMAND_S = 600.0
"""Of a command with all its restarts, each of a few seconds on an idle machine."""

_HERE = Path(__file__).resolve().parent
_COMMAND = (
    *(*POINT[:-1], "plan.gpus=2", "plan.backend=cpu", "reduce.strategy=mpr"),
    *(f"num_timesteps={ITERATIONS * 2 * STEPS}", f"run.checkpoint_every={CHECKPOINT_EVERY}"),
    *("run.keep_checkpoints=3", "run.resume=auto"),
)
_HUNG = ("stop", "suspend")
"""Kinds that begin so are for a job that takes what hangs for dead within seconds."""

_MEASURED = ("kill_measuring", "kill_controller_measuring")


def run_job(faults: Sequence[Fault], cwd: Path, expected: list[np.ndarray]) -> Report:
    """Runs a job with faults to its end in `cwd`, which is made; raises nothing."""
    job = _Job(faults, cwd)
    leaks = []
    is_full = any(fault.kind == "disk_full" for fault in faults)
    with disk_of("small" if is_full else "folder", cwd):
        try:
            leaks = job.run(expected)
        except Exception as error:
            leaks = [f"{type(error).__name__}: {error}"]
            send(processes_of(cwd), signal.SIGKILL)
        if leaks or job.wrong:
            big = shutil.ignore_patterns("filler", "cache")
            shutil.copytree(cwd / "disk", cwd / "kept", ignore=big, dirs_exist_ok=True)
    return Report(job.came(), leaks, job.lost)


class _Job:
    def __init__(self, faults: Sequence[Fault], cwd: Path) -> None:
        self.commands = 0
        self._copies: set[str] = set()
        self.lost: list[str] = []
        self.wrong: dict[int, str] = {}
        self._faults = list(faults)
        self._draw = random.Random(len(self._faults))
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
        left = fault_checks.left_in_shared_places(before, self._cwd)
        left += fault_checks.left_in_folder(self._run)
        wrong = fault_checks.what_is_wrong(self._run)
        found = learner_arrays(self._run)
        if expected and not (
            len(found) == len(expected) and all(map(np.array_equal, found, expected))
        ):
            wrong.append("it has not learnt what the undisturbed job did, bit by bit")
        copies = copies_in(self._run)
        self.lost += [f"copy {name}" for name in self._copies if name not in copies]
        return [*left, *wrong]

    def came(self) -> list[Came]:
        """All faults with their outcomes."""
        fired, found = self._fired(), []
        for number, fault in enumerate(self._faults):
            is_missing = number not in fired and KINDS[fault.kind].place != "command"
            outcome = "it did not come" if is_missing else "as wanted"
            found.append(Came(fault.kind, fault.iteration, self.wrong.get(number, outcome)))
        return found

    def _give_command(self) -> bool:
        """Starts or resumes the job and waits for its end; returns whether it must be resumed."""
        fired, newest = self._fired(), newest_whole(self._run)
        code = self._command()
        self.commands += 1
        now = [number for number in sorted(self._fired()) if number not in fired]
        wait_until(lambda: not processes_of(self._cwd), LIMIT_S, "all processes gone", 0.1)
        self._judge(now, code, newest)
        for number in now:
            self._repair_or_damage(self._faults[number].kind)
        return code != 0

    def _command(self) -> int:
        overrides = (*_COMMAND, *(STALL if any(k.startswith(_HUNG) for k in self._kinds) else ()))
        if self._kinds & set(_MEASURED):
            overrides += ("run.measure_throughput=true",)
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
        own = {MARKER: str(self._cwd), "TMPDIR": str(self._cwd / "tmp")}
        if self._kinds & {"cache_truncated", "cache_flipped"}:
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
            stderr = (self._cwd / f"stderr_{self.commands - 1}.txt").read_text()[-600:]
            text = f"unexpected: exit code {code}, {len(faults)} faults, {stderr}"
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
        events = events_of(self._run)
        new, self._events_seen = events[self._events_seen :], len(events)
        return new

    def _repair_or_damage(self, kind: str) -> None:
        """What happens between two commands."""
        if kind == "nan":
            (self._cwd / "nan").unlink()
        elif kind == "disk_full":
            (self._cwd / "disk" / "filler").unlink()
        elif kind.startswith("cache_"):
            damage_entries(self._cwd / "cache", kind, self._draw)
        elif kind == "checkpoint_copies":
            self._copies |= add_copies(self._run)
        elif kind.startswith("checkpoint_"):
            damage_checkpoint(self._run, kind)

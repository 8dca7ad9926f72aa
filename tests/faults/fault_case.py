"""One command and one fault from outside: given, hit, judged, repaired, given again."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import fault_checks
from fault_acts import ACTS, MOMENTS, repair
from fault_commands import COMMANDS
from fault_deck import EXIT_CODES, OUTER_KINDS, Case, OuterKind
from fault_disks import disk_of
from fault_fixtures import fixture, write_tasks
from fault_processes import MARKER, Process, processes_of, send
from fault_report import Report
from training_jobs import child_environment, wait_until

LIMIT_S = 150.0
"""Of what is waited for; on an idle machine it takes seconds."""

_LOOK_S = 0.1
"""From one look to the next: to look through all processes costs as much as a start does."""

ODD_NAMES = (
    "a[b]c", "hidden=[16,16]", "back\\slash", "with space", "ünï-文", "*?", "{a,b}", "50%d",
    "it's", "a$HOME", "[", "]x[",
)  # fmt: skip
SHADOWS = ("random", "queue", "optax", "utils", "select", "jax", "numpy", "gmijax")


def run_case(case: Case, scratch: Path, fixtures: Path) -> Report:
    """Runs a case in `scratch`, which is made; raises nothing."""
    kind = OUTER_KINDS[case.kind]
    scratch.mkdir(parents=True, exist_ok=True)
    job = None
    try:
        with disk_of(kind.disk, scratch):
            job = FaultyCommand(case, kind, scratch, fixtures)
            job.run_all()
        wrong = job.wrong
    except Exception as error:
        text = "" if job is None else job.stderr()[-600:]
        wrong = [f"{type(error).__name__}: {error} {text}"]
    send(processes_of(scratch), signal.SIGKILL)  # After an error: it may still run.
    return Report.of(case.kind, case.seed, wrong)


class FaultyCommand:
    """A command that is hit once; what moments and acts know of it is `fault_acts.Running`."""

    def __init__(self, case: Case, kind: OuterKind, scratch: Path, fixtures: Path) -> None:
        self.scratch, self.command, self.disk = scratch, kind.command, kind.disk
        self.draw = random.Random(case.seed)
        self.progress_before = 0
        self.pid = 0
        self.wrong: list[str] = []
        self._commands = 0
        self._kind, self._about = kind, COMMANDS[kind.command]
        self._is_shadowed = case.kind.endswith("_shadowed")
        self._home = scratch / "disk" / "home"
        is_odd = case.kind.endswith("_odd_path")
        self.run = self._home / (self.draw.choice(ODD_NAMES) if is_odd else "run")
        for folder in (self._home, scratch / "tmp", scratch / "cwd"):
            folder.mkdir(parents=True, exist_ok=True)
        write_tasks(self._home)
        for name in SHADOWS if self._is_shadowed else ():
            (scratch / "cwd" / f"{name}.py").write_text("raise SystemExit('of the folder')")
        self._fixtures = fixtures

    def progress(self) -> int:
        """What it has finished."""
        return self._about.progress(self.run)

    def stderr(self) -> str:
        """The errors of the last command."""
        path = self.scratch / f"stderr_{self._commands - 1}.txt"
        return path.read_text(errors="replace") if path.exists() else ""

    def run_all(self) -> None:
        """Gives the command, hits it, and gives it again where it has ended before its time."""
        before = fault_checks.before()
        job = self._hit()
        is_over = self._kind.outcome not in ("goes on", "restarted")
        if is_over:
            self._judge_end(job)
            wanted = self._restored()
            self._require_no_processes()
            job = self._start()
        else:
            wanted = self.progress()
        self._end_well(job, wanted)
        self._require_no_processes()
        self.wrong += self._about.wrong(self.run)
        self.wrong += fault_checks.left_in_folder(self.run)
        self.wrong += fault_checks.left_in_shared_places(before, self.scratch)

    def _hit(self) -> subprocess.Popen[bytes]:
        """Starts it and hits it; again, if it was over before."""
        for longest_s in (4.0, 1.0, 0.0, 0.0):
            for path in (self.run, self._home / "store"):
                shutil.rmtree(path, ignore_errors=True)
            if self._about.needs is not None:
                shutil.copytree(fixture(self._about.needs, self._fixtures), self.run)
            job = self._start()
            moment = MOMENTS[self._kind.moment]
            wait_until(
                lambda job=job, moment=moment: job.poll() is not None or moment(self),
                LIMIT_S,
                f"{self._kind.moment} of {self.command}",
                _LOOK_S,
            )
            is_there = True
            if self._kind.moment == "any":
                time.sleep(self.draw.uniform(0.0, longest_s))
                is_there = moment(self)  # What is only about to exit is not hit.
            if is_there and job.poll() is None:
                self._saved_before = self.progress()
                ACTS[self._kind.does](self, self._kind.whom)
                return job
            assert self._wait(job) == 0, "it ended by itself"
        raise AssertionError("it ends before it can be hit")

    def _restored(self) -> int:
        """Repairs what was done; returns what the next command must go on from."""
        if self._kind.does == "remove":
            shutil.rmtree(self.run, ignore_errors=True)
            return 0
        repair(self, self._kind.does)
        now = self.progress()
        if now < self._saved_before:
            self.wrong.append(f"lost: {self._saved_before} was there, and now {now}")
        return now

    def _judge_end(self, job: subprocess.Popen[bytes]) -> None:
        code, wanted = self._wait(job), EXIT_CODES[self._kind.outcome]
        if code != wanted:
            self.wrong.append(f"exit code {code}, not {wanted}: {self.stderr()[-600:]}")
        if code != -9:
            self.wrong += fault_checks.not_one_line(self.stderr(), self._about.verb)
        if self._kind.says not in self.stderr():
            self.wrong.append(f"{self._kind.says!r} is not in {self.stderr()[-600:]}")

    def _end_well(self, job: subprocess.Popen[bytes], wanted: int) -> None:
        if self._about.is_endless:
            wait_until(
                lambda: job.poll() is not None or self._has_gone_on(wanted),
                LIMIT_S,
                "it goes on",
                _LOOK_S,
            )
            send([Process(job.pid, "controller")], signal.SIGTERM)
        code = self._wait(job)
        if code != (130 if self._about.is_endless else 0):
            self.wrong.append(f"it must go on, but exit code {code}: {self.stderr()[-600:]}")
        if "Traceback" in self.stderr():
            self.wrong.append(f"a traceback: {self.stderr()[-600:]}")
        if self.progress() < wanted:
            self.wrong.append(f"lost: {wanted} was there, and at the end {self.progress()}")
        if self._kind.does == "suspend":
            runs = [path.parent for path in self.run.rglob("events.jsonl")]
            faults = [event for run in runs for event in fault_checks.events_of(run, "fault")]
            self.wrong += [f"taken for a fault: {event}" for event in faults]
        starts = fault_checks.events_of(self.run, "start")
        if self._kind.outcome == "restarted" and len(starts) < 2:
            self.wrong.append(f"it was not started again: {starts}")

    def _has_gone_on(self, wanted: int) -> bool:
        starts = fault_checks.events_of(self.run, "start")
        is_again = self._kind.outcome != "restarted" or len(starts) > 1
        return is_again and self.progress() > wanted

    def _start(self) -> subprocess.Popen[bytes]:
        names = {"run": str(self.run), "home": str(self._home), "n": str(self._commands)}
        overrides = (*self._about.overrides, *self._kind.overrides)
        words = [self._filled(key, names) for key in overrides]
        own = {MARKER: str(self.scratch), "TMPDIR": str(self.scratch / "tmp")}
        if self.disk.startswith("cache"):
            own["JAX_COMPILATION_CACHE_DIR"] = str(self.scratch / "cache")
        with (
            (self.scratch / f"stdout_{self._commands}.txt").open("wb") as out,
            (self.scratch / f"stderr_{self._commands}.txt").open("wb") as err,
        ):
            job = subprocess.Popen(
                [sys.executable, "-P", "-m", f"gmijax.{self._about.verb}", *words],
                cwd=self.scratch / "cwd",
                env=child_environment() | own,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )
        self._commands += 1
        self.pid = job.pid
        return job

    def _filled(self, override: str, names: dict[str, str]) -> str:
        key, _, value = override.partition("=")
        if key == "env":
            return f"env={self._home}/{value}"
        for name, path in names.items():
            value = value.replace(f"{{{name}}}", path)
        is_path = str(self._home) in value
        quoted = value.replace("'", "\\'")
        return f"{key}='{quoted}'" if is_path else f"{key}={value}"

    def _wait(self, job: subprocess.Popen[bytes]) -> int:
        try:
            return job.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"it does not end within {LIMIT_S:.0f} s") from None

    def _require_no_processes(self) -> None:
        limit_s = 60.0
        end_s = time.monotonic() + limit_s
        while (left := processes_of(self.scratch)) and time.monotonic() < end_s:
            time.sleep(0.1)
        self.wrong += [f"leaked: {process}" for process in left]
        send(left, signal.SIGKILL)

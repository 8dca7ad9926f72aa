"""Packs with real processes on the CPU: commands of another environment, which fail and hang."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from training_jobs import start, train, wait_until

from gmijax.errors import SweepFailed
from gmijax.machine.processes import identify, wait_until_gone
from gmijax.packs.pack import pack
from gmijax.sweeps import held_jobs

TRAINER = """
import argparse, importlib.util, signal, sys, time

given = argparse.ArgumentParser()
given.add_argument("--seed", type=int)
given.add_argument("--lr", type=float)
given.add_argument("--dir")
given.add_argument("--resume", action="store_true")
given = given.parse_args()
assert importlib.util.find_spec("gmijax") is None, "not of this environment"
with open(f"{given.dir}/starts", "a") as starts:
    print("again" if given.resume else "first", file=starts)
if given.seed == 3:
    sys.exit("ValueError: no such seed")
for step in range(1, 31):
    if given.seed == 2 and step == 5:
        time.sleep(1000)
    # As Stable-Baselines3 prints.
    print(f"|    ep_rew_mean     | {given.lr * step + given.seed:.3g} |")
    print(f"|    total_timesteps | {step * 512} |")
    time.sleep(0.05)
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment without gmijax or anything else."""
    folder = tmp_path_factory.mktemp("their") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    return folder / "bin" / "python"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A working folder with the script of a trainer."""
    (tmp_path / "trainer.py").write_text(TRAINER)
    return tmp_path


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "pack.json").read_text())


def state_of(folder: Path) -> str | None:
    """That of the only job, as the pack last wrote it."""
    jobs = report(folder)["jobs"] if (folder / "pack.json").exists() else []
    return jobs[0]["state"] if jobs else None


def running_in(folder: Path) -> list[str]:
    """Commands of processes that name the folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace")
        except OSError:
            continue
        if str(folder) in words and "trainer.py" in words:
            found.append(words.replace("\0", " "))
    return found


def commands_of(python: Path, *words: str) -> tuple[str, ...]:
    trainer = ("trainer.py", "--seed", "{seed}", "--lr", "{lr}", "--dir", "{run_dir}")
    apart = "pack.env.PYTHONPATH=''"  # This process may have found gmijax by that.
    return (*words, apart, "pack.jobs_per_gpu=2", "--", str(python), *trainer)


@pytest.mark.timeout(300)
def test_one_fails_one_hangs_and_a_killed_pack_goes_on(home: Path, python: Path) -> None:
    folder = home / "all"
    line = commands_of(
        python,
        *("seed=0,1,2,3", "lr=0.1,1", "run.dir=all", "pack.stall_s=6"),
        "pack.resume=--resume",
    )
    first = start(*line, cwd=home, command="pack")

    def files_of(number: int) -> Path:
        return folder / f"{number:03d}" / "pack"

    def that_has_begun() -> int | None:
        """A job that has reported and is not through, once the first one is."""
        assert first.poll() is None
        running = [n for n in range(1, 4) if not (files_of(n) / "summary.json").exists()]
        begun = [n for n in running if (files_of(n) / "metrics.jsonl").exists()]
        return begun[0] if begun and (files_of(0) / "summary.json").exists() else None

    begun = wait_until(that_has_begun, 120.0, "a job is through, and another has begun")
    first.send_signal(signal.SIGKILL)
    first.wait()
    wait_until(lambda: not running_in(folder), 60.0, "the jobs of a killed pack have ended")
    whole = (folder / "000" / "pack" / "summary.json").stat().st_mtime_ns

    done = train(*line, cwd=home, command="pack")
    assert done.returncode == 1, done.stderr
    assert "4 of 8 jobs failed; job 4: printed nothing for 6 s (pack.stall_s)" in done.stderr
    assert "all/004/pack/output.log)" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    found = report(folder)
    assert [job["state"] for job in found["jobs"]] == ["completed"] * 4 + ["failed"] * 4
    assert [job["exit_code"] for job in found["jobs"]] == [0] * 4 + [-9, -9, 1, 1]
    assert found["jobs"][6]["error"] == "exit code 1: ValueError: no such seed"
    assert (
        folder / "000" / "pack" / "summary.json"
    ).stat().st_mtime_ns == whole  # It did not run again.
    assert (folder / "000" / "starts").read_text() == "first\n"
    # What the kill has ended went on by its own words.
    assert (folder / f"{begun:03d}" / "starts").read_text().split() == ["first", "again"]
    rates = [job["env_steps_per_s"] for job in found["jobs"][1:4]]
    assert all(100 < rate < 20_000 for rate in rates)
    settings = csv.DictReader((folder / "settings.csv").read_text().splitlines())
    assert [row["lr"] for row in settings] == ["1", "0.1"]
    best = found["settings"][0]
    assert (best["overrides"], best["n"]) == ({"lr": "1"}, 3)  # One of them until it hung.
    assert (folder / "pack.png").stat().st_size > 10_000
    assert running_in(folder) == []

    other = train(*line[:-1], "elsewhere", cwd=home, command="pack")
    assert other.returncode == 2
    assert "holds another pack" in other.stderr


@pytest.mark.timeout(120)
def test_sigterm_asks_the_jobs_and_waits_for_them(home: Path) -> None:
    (home / "trainer.py").write_text(
        "import signal, sys, time\n"
        "def save(*_):\n    print('saved', flush=True)\n    sys.exit(0)\n"
        "signal.signal(signal.SIGUSR1, save)\nprint('runs', flush=True)\ntime.sleep(1000)\n"
    )
    folder = home / "all"
    words = ("pack.copies=2", "pack.jobs_per_gpu=2", "pack.stop_signal=USR1", "run.dir=all")
    job = start(*words, "--", sys.executable, "trainer.py", "{run_dir}", cwd=home, command="pack")
    logs = [folder / f"{n:03d}" / "pack" / "output.log" for n in range(2)]
    wait_until(
        lambda: all(log.exists() and "runs" in log.read_text() for log in logs), 60.0, "both run"
    )
    job.send_signal(signal.SIGTERM)
    assert job.wait(60) == 130
    assert all(log.read_text().endswith("saved\n") for log in logs)
    assert [row["state"] for row in report(folder)["jobs"]] == ["interrupted"] * 2
    assert running_in(folder) == []


def test_events_for_programs(home: Path, python: Path) -> None:
    line = commands_of(python, "--json", "seed=0,3", "lr=1", "run.dir=all")
    done = train(*line, cwd=home, command="pack")
    assert done.returncode == 1
    events = [json.loads(text) for text in done.stdout.splitlines()]
    kinds = [event["event"] for event in events]
    assert kinds[0] == "pack_started"
    assert kinds[-1] == "pack_ended"
    assert events[-1]["status"] == "failed"
    started = [event["job"] for event in events if event["event"] == "job_started"]
    assert sorted(started) == [0, 1]
    ended = {event["job"]: event for event in events if event["event"] == "job_ended"}
    assert ended[0]["state"] == "completed"
    assert ended[0]["env_steps"] == 30 * 512
    assert ended[1]["exit_code"] == 1
    assert "no such seed" in Path(ended[1]["log"]).read_text()
    assert all(event["env_steps"] > 0 for event in events if event["event"] == "progress")


def test_a_pack_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    print_steps = "for k in range({n}): print(f'at {{k}} of'); import time; time.sleep(.02)"
    found = pack(
        [sys.executable, "-c", print_steps],
        {"n": (5, 9)},
        run_dir="all",
        steps=r"at (\d+) of",
        max_restarts=1,
    )
    assert found.root == tmp_path / "all"
    assert [job["env_steps"] for job in found.report["jobs"]] == [4, 8]
    assert os.listdir(tmp_path) == ["all"]


def test_without_a_reward_the_table_has_what_is_known_and_a_hint(tmp_path: Path) -> None:
    line = ("x=1,2", "seed=0,1", "run.dir=p", "--", sys.executable, "-c", "print('{x} {seed}')")
    done = train(*line, cwd=tmp_path, command="pack")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    (heading,) = [number for number, text in enumerate(lines) if text.startswith("job  ")]
    assert lines[heading].split() == ["job", "overrides", "time", "state"]
    assert lines[heading + 1].split()[:3] == ["0", "x=1", "seed=0"]
    assert not [text for text in lines if " - " in text or "metric -" in text]
    hint = (
        "no reward was found in the output: pack.metric says where it is, e.g. "
        r"pack.metric='reward (-?[\d.]+)', or pack.tag; steps by pack.steps='step (\d+)'"
    )
    assert lines.index(hint) < heading  # As soon as the first job is complete.
    assert lines.count(hint) == 1


def test_a_command_that_cannot_be_started_does_not_end_the_others(tmp_path: Path) -> None:
    (tmp_path / "alien").write_bytes(b"\x7fELF of nothing")
    (tmp_path / "alien").chmod(0o755)
    (tmp_path / "late").write_text("#!/bin/sh\n")
    (tmp_path / "late").chmod(0o755)
    # The first one runs until the next is refused, and another one has its place until then.
    wait = "until grep -qs cannot all/pack.json; do sleep 0.1; done; chmod a-x late"
    until = "while test -x late; do sleep 0.1; done"
    lines = (f"bash -c '{wait}'", "./alien", f"bash -c '{until}'", "./late", "echo last")
    (tmp_path / "cmds.txt").write_text("\n".join(lines))
    words = ("pack.commands=cmds.txt", "pack.jobs_per_gpu=2", "run.dir=all")
    done = train(*words, cwd=tmp_path, command="pack")
    assert done.returncode == 1
    assert f"2 of 5 jobs failed; job 1: cannot be started ({tmp_path}/alien: Exec" in done.stderr
    found = report(tmp_path / "all")["jobs"]
    states = [job["state"] for job in found]
    assert states == ["completed", "failed", "completed", "failed", "completed"]
    assert found[3]["error"] == f"cannot be started ({tmp_path}/late: Permission denied)"


def test_a_missing_working_folder_is_named(tmp_path: Path) -> None:
    words = ("pack.copies=2", "pack.cwd={run_dir}/sub", "run.dir=all")
    done = train(*words, "--", "true", cwd=tmp_path, command="pack")
    assert done.returncode == 1
    assert f"working folder {tmp_path}/all/000/sub: No such file" in done.stderr
    assert [job["state"] for job in report(tmp_path / "all")["jobs"]] == ["failed"] * 2


LEAVES = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    print("pid", os.getpid(), flush=True)
    time.sleep(600)
sys.exit(3)
"""


def test_what_a_job_leaves_outside_its_group_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(held_jobs, "_LIMIT_S", 6.0)
    try:
        with pytest.raises(SweepFailed, match=r"still runs in its folder: end it \(kill (\d+)\)"):
            pack([sys.executable, "-c", LEAVES], run_dir="all", copies=1, max_restarts=1)
    finally:
        log = (tmp_path / "all" / "000" / "pack" / "output.log").read_text()
        left = [int(word) for word in re.findall(r"^pid (\d+)", log, re.MULTILINE)]
        for pid in left:
            os.kill(pid, signal.SIGKILL)
    (job,) = report(tmp_path / "all")["jobs"]
    assert len(left) == 1  # It was not started beside it.
    assert f"(kill {left[0]})" in job["error"]
    assert job["error"].endswith("it was to run again, after exit code 3: " + f"pid {left[0]}")


@pytest.mark.timeout(120)
def test_a_stop_names_what_has_left_the_group_of_its_job(home: Path) -> None:
    leaves = LEAVES.replace("sys.exit(3)", "time.sleep(600)")
    words = ("pack.copies=2", "pack.jobs_per_gpu=2", "pack.stop_timeout_s=1", "run.dir=all")
    job = start(*words, "--", sys.executable, "-c", leaves, cwd=home, command="pack")
    logs = [home / "all" / f"{n:03d}" / "pack" / "output.log" for n in range(2)]
    wait_until(
        lambda: all(log.exists() and "pid " in log.read_text() for log in logs), 60.0, "both left"
    )
    left = [re.findall(r"^pid (\d+)", log.read_text(), re.MULTILINE)[0] for log in logs]
    try:
        job.send_signal(signal.SIGHUP)
        assert job.wait(60) == 130
    finally:
        for pid in left:
            os.kill(int(pid), signal.SIGKILL)
    stderr = (home / "stderr.txt").read_text()
    for number, pid in enumerate(left):
        assert re.search(rf"job {number}: process {pid} .*: end it \(kill {pid}\)", stderr)


@pytest.mark.parametrize("ends", ["before the pack", "after it"])
def test_a_killed_pack_leaves_nothing_of_a_group_whose_leader_has_ended(
    ends: str, tmp_path: Path
) -> None:
    """The leader ends by itself while the janitor still waits for that."""
    wait = "while kill -0 $PPID 2>/dev/null; do sleep 0.1; done; sleep 1"
    script = f"sleep 600 & echo $! > child; echo $$ > leader; {wait if ends == 'after it' else ''}"
    words = ("pack.copies=1", "run.dir=all")
    job = start(*words, "--", "bash", "-c", script, cwd=tmp_path, command="pack")
    try:
        leader = Path("/proc") / wait_until(
            lambda: number_in(tmp_path / "leader"), 60.0, "it runs"
        )
        child = identify(int((tmp_path / "child").read_text()))
        assert child is not None
        # A janitor knows of no process before the pack has it.
        wait_until(lambda: state_of(tmp_path / "all") == "running", 60.0, "the pack has it")
        if ends == "before the pack":
            wait_until(lambda: not leader.exists(), 10.0, "the leader has ended")
            time.sleep(0.5)  # The pack has passed it to its janitor.
    finally:
        job.kill()
        job.wait()
    left = wait_until_gone([child], timeout_s=60)
    for process in left:
        os.kill(process.pid, signal.SIGKILL)
    assert not left


def number_in(path: Path) -> str:
    return path.read_text().strip() if path.exists() else ""

"""Faults of GMIs under MPS on a GPU: `python -m tests.faults.gpu --kills 20 --out FILE`.

One training job of four GMIs that share a GPU. A busy GMI is killed again and again, one runs out
of memory, one gets stuck, the MPS daemon and its server are killed; after each fault the job must
train again. Prints a line a fault: seconds from the fault to the next iteration.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.training_jobs import heartbeat_of, pids_of, wait_until

OVERRIDES = (
    *("env=ant", "physics.impl=jax", "num_envs=2048", "plan.gpus=1", "plan.gmis_per_gpu=4"),
    *("plan.backend=mps", "num_timesteps=1000000000000", "run.checkpoint_every=20"),
    *("run.stall_timeout_s=20", "reduce.timeout_s=15"),
    "run.grace_s=3",
)

CONTROLLER = """
import dataclasses, sys
from gmijax.cli.command import command
from gmijax.config import TrainConfig
from gmijax.control import job
from gmijax.supervise.job_kinds import SYNCHRONOUS
job.training_kind = lambda _: dataclasses.replace(SYNCHRONOUS, module="tests.faults.gpu_worker")
sys.exit(command("train", TrainConfig, job.train, sys.argv[1:]))
"""


class Job:
    """The job whose GMIs are harmed."""

    def __init__(self, folder: Path, overrides: tuple[str, ...]) -> None:
        self.run, self.faults = folder / "run", folder / "faults"
        self.faults.mkdir()
        with (folder / "job.log").open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", CONTROLLER, *OVERRIDES, *overrides, f"run.dir={self.run}"],
                env={**os.environ, "GMIJAX_FAULT_DIR": str(self.faults)},
                stdout=log,
                stderr=log,
            )

    def events(self, event: str) -> list[dict[str, Any]]:
        """Those of a kind so far."""
        return [line for line in _events(self.run) if line["event"] == event]

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """As `wait_until`, while the job runs."""
        return wait_until(lambda: condition() or self.process.poll() is not None, 200, what)

    def trains(self) -> bool:
        """Whether every GMI iterates."""
        beats = [heartbeat_of(self.run, gmi) for gmi in range(4)]
        return all(beat is not None and beat.state == "running" for beat in beats)

    def checkpoints(self) -> int:
        """Newest number of steps that was saved."""
        found = self.run.glob("checkpoints/[0-9]*/meta.json")
        return max((int(path.parent.name) for path in found), default=0)

    def pid(self, gmi: int) -> int:
        """The process of a GMI."""
        beat = heartbeat_of(self.run, gmi)
        assert beat is not None
        return beat.pid


def kill_gmi(job: Job, gmi: int) -> None:
    os.kill(job.pid(gmi), signal.SIGKILL)


def ask(kind: str) -> Callable[[Job, int], None]:
    return lambda job, gmi: (job.faults / f"{kind}_{gmi}").touch()


def kill_daemon(job: Job, gmi: int) -> None:
    """Kills the MPS control daemon and server of the job."""
    directory = _pipe_directory(job.pid(gmi))
    assert directory is not None
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if b"nvidia-cuda-mps" in words and _pipe_directory(int(entry.name)) == directory:
            os.kill(int(entry.name), signal.SIGKILL)


def _pipe_directory(pid: int) -> bytes | None:
    """The pipe directory in the environment of a process; None if it has none."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return None
    found = [v for v in variables if v.startswith(b"CUDA_MPS_PIPE_DIRECTORY=")]
    return found[0] if found else None


def harm(job: Job, name: str, act: Callable[[Job, int], None], gmi: int) -> dict[str, Any]:
    """One fault, and how long until all GMIs iterate again."""
    restarts, saved = len(job.events("fault")), job.checkpoints()
    job.wait(lambda: job.trains() and job.checkpoints() > saved, "a newer checkpoint")
    started_s = time.monotonic()
    act(job, gmi)
    job.wait(lambda: len(job.events("fault")) > restarts, "the fault to be seen")
    seen_s = time.monotonic() - started_s
    job.wait(lambda: len(job.events("recovered")) > restarts and job.trains(), "training again")
    fault = (job.events("fault") or [{}])[-1]
    row = {
        "fault": name,
        "gmi": gmi,
        "named": fault.get("gmi"),
        "cause": str(fault.get("cause"))[:160],
        "seconds": round(time.monotonic() - started_s, 2),
        "of_which_until_seen": round(seen_s, 2),
        "recovered": job.process.poll() is None,
    }
    print(json.dumps(row), flush=True)  # noqa: T201
    return row


def _events(run: Path) -> list[dict[str, Any]]:
    lines = (run / "events.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def _stacks(run: Path) -> str:
    logs = [path.read_text() for path in run.glob("gmi_*/attempt_*/stderr.log")]
    return "".join(text[-1500:] for text in logs if "most recent call first" in text)


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=1e9, help="none begins later")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_args()
    draw = random.Random(0)
    faults = [("oom", ask("oom")), ("stuck", ask("stuck")), ("daemon", kill_daemon)]
    faults += [("kill", kill_gmi)] * given.kills
    end_s, rows = time.monotonic() + given.seconds, []
    with tempfile.TemporaryDirectory() as folder:
        job = Job(Path(folder), tuple(given.overrides))
        try:
            for name, act in faults:
                if time.monotonic() > end_s or job.process.poll() is not None:
                    break
                rows.append(harm(job, name, act, draw.randrange(4)))
        finally:
            job.process.send_signal(signal.SIGTERM)
            code = job.process.wait()
            found = {
                "rows": rows,
                "exit_code": code,
                "plan": json.loads((job.run / "plan.json").read_text())["reasons"],
                "left": pids_of(job.run),
                "events": _events(job.run)[-400:],
                "log": (Path(folder) / "job.log").read_text()[-3000:],
                "stacks": _stacks(job.run)[:4000],
            }
            given.out.write_text(json.dumps(found, indent=1))
    return 0 if code == 130 and not found["left"] else 1


if __name__ == "__main__":
    sys.exit(main())

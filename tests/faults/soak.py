"""A long training run, and what its processes hold: `python -m tests.faults.soak --minutes 60`.

Memory, open files and threads of the controller, the janitor and every GMI are read from /proc at
even distances; none may grow from the second quarter of the run to the last one. Everything after
`--` goes to `gmijax.train`, e.g. `-- env=ant plan.backend=mps`.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

SAMPLES = 240
ALLOWED_MIB = 16.0
"""Growth of memory that is the allocator's: that of a leak goes on for as long as the run."""

DEFAULTS = (
    *("env=ball_balance", "num_envs=64", "plan.gpus=1", "plan.gmis_per_gpu=2"),
    *("run.checkpoint_every=200", "num_timesteps=1000000000000"),
)


class Sample(NamedTuple):
    """What a process holds.

    Attributes:
      memory_mib: resident memory that is its own: without pages of files and shared memory.
      descriptors: open files.
      threads: of the process.
    """

    memory_mib: float
    descriptors: int
    threads: int


def sample(pid: int) -> Sample | None:
    """Of a running process, None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        lines = (folder / "status").read_text().splitlines()
        fields = dict(line.split(":", 1) for line in lines)
        return Sample(
            int(fields["RssAnon"].split()[0]) / 1024,
            len(os.listdir(folder / "fd")),
            int(fields["Threads"]),
        )
    except (OSError, KeyError):
        return None


def processes_of(controller: int) -> dict[str, int]:
    """The controller and its children, by what they are."""
    found = {"controller": controller}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            words = (entry / "cmdline").read_bytes().split(b"\0")
            variables = (entry / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if parent == controller:
            gmi = [
                v.partition(b"=")[2].decode() for v in variables if v.startswith(b"GMIJAX_GMI=")
            ]
            name = f"gmi_{gmi[0]}" if gmi else words[2].decode().rpartition(".")[2]
            found[name] = int(entry.name)
    return found


def growth(samples: Sequence[Sample]) -> Mapping[str, float]:
    """Medians of the last quarter less those of the second, of every field."""
    quarter = len(samples) // 4
    early, late = samples[quarter : 2 * quarter], samples[3 * quarter :]
    return {
        field: statistics.median(getattr(s, field) for s in late)
        - statistics.median(getattr(s, field) for s in early)
        for field in Sample._fields
    }


def watch(overrides: Sequence[str], minutes: float, run: Path) -> dict[str, list[Sample]]:
    """Trains for that long; returns the samples of every process."""
    taken: dict[str, list[Sample]] = {}
    with (run.parent / "soak.log").open("wb") as log:
        job = subprocess.Popen(
            [sys.executable, "-m", "gmijax.train", *overrides, f"run.dir={run}"],
            stdout=log,
            stderr=log,
        )
        try:
            while not (run / "metrics.jsonl").exists():
                if job.poll() is not None:
                    raise SystemExit((run.parent / "soak.log").read_text())
                time.sleep(1)
            end_s = time.monotonic() + 60 * minutes
            while time.monotonic() < end_s and job.poll() is None:
                for name, pid in processes_of(job.pid).items():
                    if (now := sample(pid)) is not None:
                        taken.setdefault(name, []).append(now)
                time.sleep(60 * minutes / SAMPLES)
        finally:
            job.send_signal(signal.SIGTERM)
            code = job.wait()
    if code != 130:
        raise SystemExit(f"exit code {code}: " + (run.parent / "soak.log").read_text()[-2000:])
    return taken


def report(taken: Mapping[str, Sequence[Sample]], minutes: float) -> bool:
    """Prints a line a process; returns whether all are flat."""
    is_flat = True
    for name, samples in taken.items():
        grown = growth(samples)
        flat = grown["memory_mib"] <= ALLOWED_MIB
        flat &= grown["descriptors"] <= 0 and grown["threads"] <= 0
        is_flat &= flat
        middle, last = samples[len(samples) // 2], samples[-1]
        row = {"process": name, "minutes": minutes, "samples": len(samples), "flat": flat}
        row |= {"middle": middle._asdict(), "last": last._asdict(), "growth": grown}
        print(json.dumps(row))  # noqa: T201
    return is_flat


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        overrides = (*DEFAULTS, *given.overrides)
        taken = watch(overrides, given.minutes, Path(folder) / "run")
        lines = (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()
    print(json.dumps({"iterations": len(lines), "last": json.loads(lines[-1])["env_steps"]}))  # noqa: T201
    return 0 if report(taken, given.minutes) else 1


if __name__ == "__main__":
    sys.exit(main())

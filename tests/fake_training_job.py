"""Stands in for `gmijax.workers.training_job` as a client of the fake MPS daemon.

It takes steps, with a checkpoint after each. With seed 1 it has a fatal fault at FAULT_AT, which
ends all clients of its daemon; the first time, when the others with an odd seed have come as far.
"""

import json
import os
import sys
import time
from pathlib import Path

from gmijax.machine.snapshot import DAEMONS_VARIABLE

FAULT_AT, STEPS, ODD_ONES = 5, 10, 3


def main() -> None:
    (config,) = json.loads(Path(sys.argv[1]).read_text())["configs"]
    run, seed = Path(config["run"]["dir"]), config["seed"]
    run.mkdir(exist_ok=True)
    (pipe,) = map(Path, json.loads(os.environ[DAEMONS_VARIABLE]).values())
    saved, clients = run / "step", pipe / "clients"
    step = int(saved.read_text()) if saved.exists() else 0
    may_wait = step == 0 and seed % 2 == 1
    with (run / "starts").open("a") as starts:
        starts.write(f"from step {step} beside {len(list(clients.iterdir()))}\n")
    own = clients / str(os.getpid())
    own.touch()
    while step < STEPS:
        time.sleep(0.02)
        if not own.exists():
            sys.stderr.write("gmijax.train: GMI 0 failed: exit code 1: CUDA_ERROR_LAUNCH_FAILED\n")
            sys.exit(1)
        if step < FAULT_AT or not (may_wait or seed == 1):
            step += 1
            saved.write_text(str(step))
            with (run / "metrics.jsonl").open("a") as metrics:
                metrics.write(json.dumps({"env_steps": step, "return": float(step)}) + "\n")
        elif seed == 1 and (not may_wait or waiting(run.parent) == ODD_ONES):
            for client in clients.iterdir():
                client.unlink()
    own.unlink()


def waiting(sweep: Path) -> int:
    """How many jobs with an odd seed have come to the fault."""
    files = [sweep / f"{number:03d}" / "step" for number in (1, 3, 5)]
    return sum(file.exists() and file.read_text() == str(FAULT_AT) for file in files)


if __name__ == "__main__":
    main()

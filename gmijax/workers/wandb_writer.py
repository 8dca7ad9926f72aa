"""Main of the process that follows a run for Weights & Biases: `wandb_writer.py RUN_DIR`.

A process of its own, so that nothing of it can end or delay training. It gets the configuration
as the first line of its standard input and ends, with the summary, when that ends.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gmijax.runs.folder import RunPaths, read_json, write_json
from gmijax.runs.history import MetricsReader, scalars

_POLL_S = 2.0


def main(root: Path) -> int:
    """Returns the exit code: 0, or 1 with one line on standard error."""
    # In one piece: what is left in a buffer would not wake up `select`.
    config = json.loads(os.read(sys.stdin.fileno(), 1 << 20))
    try:
        follow(RunPaths(root), config)
    # Whatever it is, training goes on without it.
    except Exception as error:
        sys.stderr.write(f"{type(error).__name__}: {' '.join(str(error).split())}\n")
        return 1
    return 0


def follow(run: RunPaths, config: Mapping[str, Any]) -> None:
    """Logs the lines of metrics as they come, until standard input ends.

    What was logged under the run's id before, by the run that it resumes, is not logged again:
    Weights & Biases takes steps in ascending order only.
    """
    import wandb

    said = config["wandb"]
    known = read_json(run.wandb) if run.wandb.exists() else {}
    last = known.get("env_steps", -1)
    board = wandb.init(
        id=known.get("id", secrets.token_hex(4)),
        resume="allow",
        name=run.root.name,
        project=said["project"],
        group=said["group"],
        config=dict(config),
        dir=run.root,
        settings=wandb.Settings(mode=said["mode"], silent=True, console="off"),
    )
    write_json(run.wandb, {"id": board.id, "env_steps": last})
    reader = MetricsReader(run.metrics)
    is_over = False
    while not is_over:
        is_over = bool(select.select([sys.stdin], [], [], _POLL_S)[0])
        new = [line for line in reader.new() if line["env_steps"] > last]
        for line in new:
            last = line["env_steps"]
            board.log(scalars(line), step=last)
        if new:
            write_json(run.wandb, {"id": board.id, "env_steps": last})
    summary = read_json(run.summary) if run.summary.exists() else {"status": "failed"}
    board.summary.update(summary)
    board.finish(exit_code=int(summary["status"] == "failed"))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

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
from gmijax.runs.names import by_steps
from gmijax.runs.result import summary_of
from gmijax.supervise.side_process import exit_code_beside

_POLL_S = 2.0


def main(root: Path) -> int:
    """Returns the exit code: 0, or 1 with one line on standard error."""
    # In one piece: what is left in a buffer would not wake up `select`.
    config = json.loads(os.read(sys.stdin.fileno(), 1 << 20))
    return exit_code_beside(lambda: follow(RunPaths(root), config))


def follow(run: RunPaths, config: Mapping[str, Any]) -> None:
    """Logs lines of metrics and films of evaluations as they come, until standard input ends.

    What was logged under the run's id before, by the run that it resumes, is not logged again:
    Weights & Biases takes steps in ascending order only.
    """
    import wandb

    known = read_json(run.wandb) if run.wandb.exists() else {}
    last, filmed = known.get("env_steps", -1), known.get("filmed_env_steps", -1)
    board = _open(run, config, known.get("id", secrets.token_hex(4)))
    write_json(run.wandb, {**known, "id": board.id, "env_steps": last})
    reader = MetricsReader(run.metrics)
    is_over = False
    while not is_over:
        is_over = bool(select.select([sys.stdin], [], [], _POLL_S)[0])
        new = [line for line in reader.new() if line["env_steps"] > last]
        for line in new:
            last = line["env_steps"]
            board.log(scalars(line), step=last)
        film = next(reversed(by_steps(run.videos, suffix=".mp4")), None)
        is_new = film is not None and int(film.stem) > filmed and last >= 0
        if film is not None and is_new:
            filmed = int(film.stem)
            video = wandb.Video(str(film), caption=f"{filmed} env steps", format="mp4")
            # It comes later than the line of its evaluation, whose step has gone by.
            board.log({"eval/video": video}, step=last)
        if new or is_new:
            reached = {"env_steps": last, "filmed_env_steps": filmed}
            write_json(run.wandb, {"id": board.id, **reached})
    summary = summary_of(run) or {"status": "failed"}
    board.summary.update(summary)
    board.finish(exit_code=int(summary["status"] == "failed"))


def _open(run: RunPaths, config: Mapping[str, Any], board_id: str) -> Any:
    """The run at Weights & Biases."""
    import wandb

    settings = config["wandb"]
    return wandb.init(
        id=board_id,
        resume="allow",
        name=run.root.name,
        project=settings["project"],
        group=settings["group"],
        config=dict(config),
        dir=run.root,
        settings=wandb.Settings(mode=settings["mode"], silent=True, console="off"),
    )


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

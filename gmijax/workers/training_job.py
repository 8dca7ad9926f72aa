"""Main of training jobs of a sweep: a controller of its own, `training_job.py ORDER FD`.

It trains one job, or several that are one program.

It ends, with a checkpoint, when the pipe FD ends: the sweep is gone then. Any byte that comes
before is Ctrl-C.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from gmijax.config import TrainConfig
from gmijax.config.schema import from_dict
from gmijax.control.exit_codes import exit_code_of
from gmijax.control.job import train
from gmijax.control.packed import train_packed
from gmijax.runs.folder import read_json


def main(order: Path, lifeline_fd: int) -> int:
    """Trains as the file `order` describes; returns the exit code of `gmijax.train`."""
    # A shell may have made the sweep ignore it; only the sweep sends it here.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_the_sweep, args=(lifeline_fd,), daemon=True).start()
    data = read_json(order)
    if data["cpus"]:
        os.sched_setaffinity(0, data["cpus"])
    configs = [from_dict(TrainConfig, config) for config in data["configs"]]
    if len(configs) == 1:
        return exit_code_of("train", lambda: train(configs[0], show=True))
    return exit_code_of("train", lambda: train_packed(configs, order.with_suffix("")))


def _end_with_the_sweep(fd: int) -> None:
    while os.read(fd, 1):
        os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))

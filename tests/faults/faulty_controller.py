"""`python -m gmijax.train` whose GMIs run `faulty_worker`."""

from __future__ import annotations

import dataclasses
import signal
import sys

from gmijax.cli.command import command
from gmijax.config import TrainConfig
from gmijax.control import job
from gmijax.supervise.job_kinds import SYNCHRONOUS

if __name__ == "__main__":
    # Whoever started this may ignore it (nohup), and then so would the job.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    job.training_kind = lambda _: dataclasses.replace(SYNCHRONOUS, module="faulty_worker")
    sys.exit(command("train", TrainConfig, job.train, sys.argv[1:]))

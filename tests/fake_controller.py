"""A controller to be killed: `python fake_controller.py RUN_DIR cpu|mps MODE...`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from supervision import machine, make_launch, planned

from gmijax.machine.mps_control import find_mps_control
from gmijax.runs.folder import RunPaths
from gmijax.supervise.backends import open_backend
from gmijax.supervise.supervisor import Supervisor


def main() -> None:
    run, backend_name, modes = RunPaths(Path(sys.argv[1])), sys.argv[2], sys.argv[3:]
    num_gpus = 0 if backend_name == "cpu" else 1
    here = machine(num_gpus, mps_control=find_mps_control())
    plan = planned(here, gmis_per_gpu=len(modes), backend=backend_name)
    with open_backend(plan, here, run) as backend:
        stall_s = float(os.environ.get("FAKE_STALL_S", "90"))
        Supervisor(make_launch(run, modes, plan, stall=stall_s), backend).run()


if __name__ == "__main__":
    main()

"""The controller of `gmijax.export`: from a checkpoint to files that need no gmijax.

A child does the work, `gmijax.workers.exporter`, as the one GMI of a small plan. It runs on the
CPU: nothing is simulated, and GPUs may be training.
"""

from __future__ import annotations

import importlib.util
import json
import shlex
from pathlib import Path
from typing import Final

from gmijax.config import ExportConfig, PlanConfig, ReduceConfig, Timeouts
from gmijax.control.console import Show, nearby, open_console, print_next
from gmijax.control.progress import ConsoleProgress
from gmijax.deploy.trained_run import open_run, output_folder
from gmijax.errors import ConfigError
from gmijax.machine.snapshot import detect_machine
from gmijax.partition.planner import make_plan
from gmijax.runs.folder import ExportPaths, RunPaths
from gmijax.supervise.job_kinds import JobKind
from gmijax.supervise.run_gmis import Launch, run_gmis

_TIMEOUTS: Final = Timeouts(
    start_timeout_s=600.0, stall_timeout_s=600.0, stop_timeout_s=60.0, grace_s=10.0
)


def export(config: ExportConfig, *, show: Show = False) -> ExportPaths:
    """Writes the policy of a checkpoint as files; returns where they are.

    Args:
      config: what to export; see `python -m gmijax.export --help`.
      show: print the paths of the files.

    Raises:
      ConfigError: bad input, e.g. no such checkpoint, or a package that is not installed.
      GmiFailed: the export failed.
    """
    require_packages(config)
    config, _, changed = open_run(config)
    paths = ExportPaths(output_folder(config, "export"))
    console = open_console(show=show)
    console.print(f"checkpoint: {nearby(Path(str(config.checkpoint)))}")
    if changed:
        console.print(changed)
    with ConsoleProgress(console, list, 0, work="exporting the policy") as progress:
        run_gmis(launch_of(paths), progress.update)
    if config.format in ("onnx", "all"):
        console.print(f"ONNX: {nearby(paths.onnx)}")
    if config.format in ("stablehlo", "all"):
        console.print(f"StableHLO: {nearby(paths.stablehlo)}")
    console.print(f"metadata: {nearby(paths.metadata)}")
    path = paths.stablehlo if config.format == "stablehlo" else paths.onnx
    act = (
        f"import gmijax, numpy; policy = gmijax.load_policy({json.dumps(nearby(path))}); "
        "print(policy(numpy.zeros(policy.obs_size)))"
    )
    print_next(console, ("act with it in Python", f"python -c {shlex.quote(act)}"))
    return paths


def require_packages(config: ExportConfig) -> None:
    """Raises ConfigError if a format needs a package that is not installed."""
    if config.format == "stablehlo":
        return
    if importlib.util.find_spec("jax2onnx") is None:
        raise ConfigError(
            f"format={config.format}: needs the package jax2onnx (pip install 'gmijax[export]'); "
            "without it, use format=stablehlo"
        )


def launch_of(paths: ExportPaths) -> Launch:
    """The process that exports, on the CPU."""
    machine = detect_machine()
    return Launch(
        plan=make_plan(PlanConfig(backend="cpu"), ReduceConfig(), 1, machine),
        machine=machine,
        run=RunPaths(paths.root),
        kind=JobKind("gmijax.workers.exporter"),
        timeouts=_TIMEOUTS,
        stops_gracefully=False,
    )

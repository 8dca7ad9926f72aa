"""Measures T and R of the paper's resource model (section 5.1): what each task takes of a GPU.

`python -m benchmarks.resource_use --tasks ant humanoid` runs simulator, agent and trainer of an
iteration one after the other in one process, each alone on the GPU and over and over. While it
does, NVML's performance monitor (GPM, from Hopper on) reads which part of the SMs is busy, and
the compiler has said what memory its program takes. R is the larger part of the two (equation 1).
Adds a call to `benchmarks/results/resource-use-<device>.json`, which `python -m
benchmarks.resource_model --resources` reads.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pynvml

from benchmarks.paper_model import dominant_resource
from benchmarks.records import RESULTS, ResultsFile, file_name
from benchmarks.stages import Stage, stages
from gmijax import compose
from gmijax.machine.nvidia import nvml_session

SECONDS = 2.0
"""How long each task runs: the monitor wants a tenth of a second at least."""


class Use(NamedTuple):
    """What one task takes of a GPU.

    Attributes:
      seconds: T, of one iteration.
      sm: mean part of the SMs that were busy, 0 to 1.
      memory: part of the GPU's memory that its program needs, 0 to 1.
    """

    seconds: float
    sm: float
    memory: float

    @property
    def dominant(self) -> str:
        """`sm` or `memory`, equation 1."""
        return dominant_resource(self.sm, 1.0, self.memory, 1.0)


class Monitor:
    """NVML's performance monitor of a GPU; raises NVMLError where there is none.

    Args:
      index: of the GPU, as NVML counts.
    """

    def __init__(self, index: int) -> None:
        self._device = pynvml.nvmlDeviceGetHandleByIndex(index)
        self._samples = [pynvml.nvmlGpmSampleAlloc() for _ in range(2)]
        self.uuid = str(pynvml.nvmlDeviceGetUUID(self._device))
        self.memory_bytes = int(pynvml.nvmlDeviceGetMemoryInfo(self._device).total)

    def start(self) -> None:
        """Begins an interval."""
        pynvml.nvmlGpmSampleGet(self._device, self._samples[0])

    def busy_sms(self) -> float:
        """Mean part of the SMs that were busy since `start`, 0 to 1."""
        pynvml.nvmlGpmSampleGet(self._device, self._samples[1])
        wanted: Any = pynvml.c_nvmlGpmMetricsGet_t()
        wanted.version = pynvml.NVML_GPM_METRICS_GET_VERSION
        wanted.numMetrics = 1
        wanted.sample1, wanted.sample2 = self._samples
        wanted.metrics[0].metricId = pynvml.NVML_GPM_METRIC_SM_UTIL
        pynvml.nvmlGpmMetricsGet(wanted)
        return wanted.metrics[0].value / 100.0

    def close(self) -> None:
        """Frees the samples."""
        for sample in self._samples:
            pynvml.nvmlGpmSampleFree(sample)


def main() -> int:
    """Measures and prints; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["ant", "humanoid"])
    parser.add_argument("--num-envs", type=int, default=2048)
    parser.add_argument("--impl", choices=("jax", "warp"), default="jax")
    parser.add_argument("--gpu", type=int, default=0, help="index, as NVML counts")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    try:
        with nvml_session():
            monitor = Monitor(arguments.gpu)
            os.environ["CUDA_VISIBLE_DEVICES"] = monitor.uuid  # jax looks when it is first used.
            rows = {task: _task(task, arguments, monitor) for task in arguments.tasks}
            monitor.close()
    except pynvml.NVMLError as error:
        sys.stderr.write(f"--gpu {arguments.gpu}: NVML cannot watch it: {error}\n")
        return 2
    device = jax.local_devices()[0].device_kind
    path = arguments.out / file_name("resource-use", device)
    with ResultsFile(path, "resource-use", vars(arguments), device=device).changing() as results:
        results["tasks"] = rows
    for task, uses in rows.items():
        for name, use in uses.items():
            sys.stdout.write(
                f"{task:16}{name:10} {use['seconds'] * 1e3:9.3f} ms, SMs {use['sm']:.1%}, memory "
                f"{use['memory']:.2%}\n"
            )
    sys.stdout.write(f"written: {path}\n")
    return 0


def _task(name: str, arguments: argparse.Namespace, monitor: Monitor) -> dict[str, Any]:
    """What simulator, agent and trainer of a task take."""
    config = compose(
        f"env={name}", f"physics.impl={arguments.impl}", f"num_envs={arguments.num_envs}"
    )
    found = {}
    for stage in stages(config, arguments.impl):
        if stage.name == "iteration":
            continue
        use = _measured(stage, monitor)
        found[stage.name] = {**use._asdict(), "dominant": use.dominant}
    return found


def _measured(stage: Stage, monitor: Monitor) -> Use:
    given, state = stage.given, jax.tree.map(jnp.copy, stage.state)
    compiled = jax.jit(stage.program, donate_argnums=1).lower(given, state).compile()
    needs: Any = compiled.memory_analysis()
    memory = needs.argument_size_in_bytes + needs.temp_size_in_bytes
    state = jax.block_until_ready(compiled(given, compiled(given, state)))
    count, started = 0, time.monotonic()
    monitor.start()
    while time.monotonic() - started < SECONDS:
        for _ in range(4):
            state = compiled(given, state)
        jax.block_until_ready(state)
        count += 4
    busy, seconds = monitor.busy_sms(), time.monotonic() - started
    return Use(seconds / count, busy, memory / monitor.memory_bytes)


if __name__ == "__main__":
    sys.exit(main())

"""Which part of the SMs of GPUs is busy while a command runs, by NVML's performance monitor."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import pynvml

from gmijax.machine.nvidia import nvml_session

EVERY_S = 0.25
"""Seconds between samples. The monitor needs a tenth of a second at least."""


class BusySms:
    """Reads GPUs while it is entered; nothing where there is no monitor (CPUs, before Hopper).

    Args:
      gpus: their indices, as NVML counts.
    """

    def __init__(self, gpus: Sequence[int]) -> None:
        self._gpus = gpus
        self._readings: list[tuple[float, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> BusySms:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def between(self, begin_s: float, end_s: float) -> float | None:
        """Mean part of the SMs of all GPUs, 0 to 1; None without a reading.

        Args:
          begin_s: on the clock of `time.time`; a reading is of the `EVERY_S` before it.
          end_s: on the same.
        """
        found = [busy for at_s, busy in self._readings if begin_s + EVERY_S <= at_s <= end_s]
        return statistics.fmean(found) if found else None

    def _read(self) -> None:
        if not self._gpus:
            return
        with suppress(pynvml.NVMLError), nvml_session():
            devices = [pynvml.nvmlDeviceGetHandleByIndex(gpu) for gpu in self._gpus]
            # Two samples of each, which take turns at being the newer one.
            older, newer = ([pynvml.nvmlGpmSampleAlloc() for _ in devices] for _ in range(2))
            try:
                _take(devices, older)
                while not self._stop.wait(EVERY_S):
                    _take(devices, newer)
                    busy = [_busy(*samples) for samples in zip(older, newer, strict=True)]
                    self._readings.append((time.time(), statistics.fmean(busy)))
                    older, newer = newer, older
            finally:
                for sample in (*older, *newer):
                    pynvml.nvmlGpmSampleFree(sample)


def _take(devices: Sequence[Any], samples: Sequence[Any]) -> None:
    for device, sample in zip(devices, samples, strict=True):
        pynvml.nvmlGpmSampleGet(device, sample)


def _busy(older: Any, newer: Any) -> float:
    """Mean part of the SMs that were busy between two samples of a GPU, 0 to 1."""
    wanted: Any = pynvml.c_nvmlGpmMetricsGet_t()
    wanted.version = pynvml.NVML_GPM_METRICS_GET_VERSION
    wanted.numMetrics = 1
    wanted.sample1, wanted.sample2 = older, newer
    wanted.metrics[0].metricId = pynvml.NVML_GPM_METRIC_SM_UTIL
    pynvml.nvmlGpmMetricsGet(wanted)
    return wanted.metrics[0].value / 100.0

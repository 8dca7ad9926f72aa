"""What a benchmark reads of GPUs while a command runs."""

from __future__ import annotations

import itertools
import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import busy_sms
from benchmarks.busy_sms import BusySms


class NoMonitor(Exception):
    """As NVML raises it where there is none."""


class Nvml:
    """A monitor of two GPUs, of which the first is busy to a half and the second to all of it."""

    def __init__(self, *, has_monitor: bool = True) -> None:
        self._times = itertools.count()
        self._has_monitor = has_monitor
        self.allocated = 0

    def as_module(self) -> SimpleNamespace:
        functions = {
            "DeviceGetHandleByIndex": lambda gpu: gpu,
            "GpmSampleAlloc": self._alloc,
            "GpmSampleFree": self._free,
            "GpmSampleGet": self._sample,
            "GpmMetricsGet": self._read,
        }
        return SimpleNamespace(
            **{f"nvml{name}": function for name, function in functions.items()},
            c_nvmlGpmMetricsGet_t=lambda: SimpleNamespace(metrics=[SimpleNamespace()]),
            NVMLError=NoMonitor,
            NVML_GPM_METRICS_GET_VERSION=1,
            NVML_GPM_METRIC_SM_UTIL=2,
        )

    def _alloc(self) -> dict[str, int]:
        self.allocated += 1
        return {}

    def _free(self, _: Any) -> None:
        self.allocated -= 1

    def _sample(self, gpu: int, sample: dict[str, int]) -> None:
        if not self._has_monitor:
            raise NoMonitor
        sample.update(gpu=gpu, at=next(self._times))

    def _read(self, wanted: SimpleNamespace) -> None:
        assert wanted.sample1["gpu"] == wanted.sample2["gpu"]
        assert wanted.sample1["at"] < wanted.sample2["at"]
        wanted.metrics[0].value = 100.0 if wanted.sample1["gpu"] else 50.0


@pytest.fixture
def nvml(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Nvml:
    found = Nvml(has_monitor=getattr(request, "param", True))
    monkeypatch.setattr(busy_sms, "pynvml", found.as_module())
    monkeypatch.setattr(busy_sms, "nvml_session", nullcontext)
    monkeypatch.setattr(busy_sms, "EVERY_S", 0.001)
    return found


def test_the_mean_is_of_all_gpus_and_of_the_time_that_is_asked_for(nvml: Nvml):
    begin_s = time.time()
    with BusySms((0, 1)) as busy:
        while busy.between(begin_s, time.time()) is None:
            time.sleep(0.001)
    assert busy.between(begin_s, time.time()) == pytest.approx(0.75)
    assert busy.between(begin_s - 2.0, begin_s - 1.0) is None
    assert nvml.allocated == 0


@pytest.mark.parametrize(("nvml", "gpus"), [(False, (0,)), (True, ())], indirect=["nvml"])
def test_without_a_monitor_or_a_gpu_there_is_no_figure(nvml: Nvml, gpus: tuple[int, ...]):
    with BusySms(gpus) as busy:
        pass
    assert busy.between(0.0, time.time()) is None
    assert nvml.allocated == 0

"""What is queued on a stream, with bindings that only note what they are asked for."""

from __future__ import annotations

import importlib
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest

GEQ, FLUSH = 0, 1 << 30


@pytest.mark.parametrize(("can_flush", "expected"), [(1, GEQ | FLUSH), (0, GEQ)])
def test_a_wait_for_a_flag_waits_for_what_came_before_it_where_the_gpu_can(
    can_flush: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime, driver = MagicMock(), MagicMock()
    runtime.cudaHostRegisterMapped, runtime.cudaHostRegisterPortable = 2, 1
    success = runtime.cudaError_t.cudaSuccess
    runtime.cudaDeviceGetAttribute.return_value = success, can_flush
    runtime.cudaHostRegister.return_value = (success,)
    runtime.cudaHostGetDevicePointer.return_value = success, 1 << 20
    driver.CUstreamWaitValue_flags.CU_STREAM_WAIT_VALUE_GEQ.value = GEQ
    driver.CUstreamWaitValue_flags.CU_STREAM_WAIT_VALUE_FLUSH.value = FLUSH
    driver.cuStreamWaitValue32.return_value = (driver.CUresult.CUDA_SUCCESS,)
    monkeypatch.setitem(sys.modules, "cuda.bindings.runtime", runtime)
    monkeypatch.setitem(sys.modules, "cuda.bindings.driver", driver)
    name = "gmijax.collectives.device.cuda_queue"
    monkeypatch.delitem(sys.modules, name, raising=False)
    try:
        queue = importlib.import_module(name).CudaQueue(np.zeros((64, 16), np.uint32))
    finally:
        sys.modules.pop(name, None)
    queue.wait_for_flag(7, 3, 5)
    driver.cuStreamWaitValue32.assert_called_once_with(7, (1 << 20) + 3 * 64, 5, expected)

"""What is queued on a stream, with bindings that only note what they are asked for."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

GEQ, FLUSH = 0, 1 << 30


def bindings(can_flush: int, calls: list[tuple[Any, ...]]) -> tuple[Any, Any]:
    """Runtime and driver of a GPU."""

    def noted(name: str, *values: Any) -> Any:
        def call(*arguments: Any) -> tuple[Any, ...]:
            calls.append((name, *arguments))
            return 0, *values

        return call

    runtime = SimpleNamespace(
        cudaHostRegisterMapped=2,
        cudaHostRegisterPortable=1,
        cudaError_t=SimpleNamespace(cudaSuccess=0),
        cudaDeviceAttr=SimpleNamespace(cudaDevAttrCanFlushRemoteWrites=98),
        cudaMemcpyKind=SimpleNamespace(cudaMemcpyDeviceToDevice=3),
        cudaDeviceGetAttribute=noted("attribute", can_flush),
        cudaHostRegister=noted("register"),
        cudaHostGetDevicePointer=noted("pointer", 1 << 20),
    )
    driver = SimpleNamespace(
        CUresult=SimpleNamespace(CUDA_SUCCESS=0),
        CUstreamWaitValue_flags=SimpleNamespace(
            CU_STREAM_WAIT_VALUE_GEQ=SimpleNamespace(value=GEQ),
            CU_STREAM_WAIT_VALUE_FLUSH=SimpleNamespace(value=FLUSH),
        ),
        cuStreamWaitValue32=noted("wait"),
    )
    return runtime, driver


@pytest.mark.parametrize(("can_flush", "expected"), [(1, GEQ | FLUSH), (0, GEQ)])
def test_a_wait_for_a_flag_waits_for_what_came_before_it_where_the_gpu_can(
    can_flush: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[Any, ...]] = []
    name = "gmijax.collectives.device.cuda_queue"
    for module, fake in zip(("runtime", "driver"), bindings(can_flush, calls), strict=True):
        monkeypatch.setitem(sys.modules, f"cuda.bindings.{module}", fake)
    monkeypatch.delitem(sys.modules, name, raising=False)
    try:
        queue = importlib.import_module(name).CudaQueue(np.zeros((64, 16), np.uint32))
    finally:
        sys.modules.pop(name, None)
    queue.wait_for_flag(7, 3, 5)
    assert ("attribute", 98, 0) in calls
    assert calls[-1] == ("wait", 7, (1 << 20) + 3 * 64, 5, expected)

"""Why a command has failed, from its exit code and the end of what it printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final, NamedTuple

from gmijax.supervise.failures import last_lines, last_of, may_be_neighbours, signal_name

_TAIL_BYTES: Final = 1 << 16
_TAIL_LINES: Final = 200

_OUT_OF_MEMORY: Final = re.compile(
    r"CUDA out of memory|CUDA error: out of memory|OutOfMemoryError|CUBLAS_STATUS_ALLOC_FAILED"
    r"|RESOURCE_EXHAUSTED|CUDA_ERROR_OUT_OF_MEMORY|Failed to allocate \d+ bytes on device 'cuda"
    r"|Warp CUDA error 2\b|OOM when allocating tensor|CUDA_ERROR_MPS_MAX_CLIENTS_REACHED"
)
"""Messages of PyTorch, cuBLAS, XLA, Warp, TensorFlow, CuPy and MPS. Only read after a failure: XLA
prints its own in healthy runs too, where it can do with less."""

_GPU_FAULT: Final = re.compile(
    r"unspecified launch failure|illegal memory access|misaligned address|CUDA_ERROR_MPS_"
    r"|Warp CUDA error (?!2\b)\d+|CUDA error: (?!out of memory)"
)
"""A fatal fault of one MPS client is reported to all, and CUDA does not report whose it was."""


class Failure(NamedTuple):
    """Why a command failed.

    Attributes:
      error: in one line.
      is_out_of_memory: it found no memory on its GPU.
      is_gpu_fault: its GPU failed, perhaps because of another client of the MPS daemon.
    """

    error: str
    is_out_of_memory: bool = False
    is_gpu_fault: bool = False


def failure_of(exit_code: int, log: Path, begins: int = 0) -> Failure:
    """Why a command has failed.

    Args:
      exit_code: negative for the signal that ended it.
      log: what it printed.
      begins: byte of the log where that begins.
    """
    lines = last_lines(log, _TAIL_BYTES, begins)[-_TAIL_LINES:]
    how = f"exit code {exit_code}" if exit_code >= 0 else f"ended by {signal_name(-exit_code)}"
    for pattern in (_OUT_OF_MEMORY, _GPU_FAULT):
        found = next((line for line in reversed(lines) if pattern.search(line)), None)
        if found is not None:
            text = f"{how}: {last_of([found])}"
            is_memory = pattern is _OUT_OF_MEMORY
            return Failure(text, is_memory, not is_memory)
    last = last_of(lines)
    text = f"{how}: {last}" if last else how
    return Failure(text, is_gpu_fault=may_be_neighbours(text))

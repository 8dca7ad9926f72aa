"""The device of a GMI: where programs put what the host reads, and its entry in a summary."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import jax
from jax.sharding import Sharding, SingleDeviceSharding

from gmijax.errors import ConfigError

PEAKS_BESIDE_JAX: list[Callable[[], int]] = []
"""Each returns the peak bytes of this process's GPU that a library other than JAX had."""


def start_device() -> None:
    """Starts this process's device in a thread of its own, while the caller imports.

    CUDA spends a second or more in its driver. The first call that uses the device waits for the
    rest, and gets the error if there is one.
    """

    def start() -> None:
        with suppress(Exception):
            jax.local_devices()

    threading.Thread(target=start, name="device", daemon=True).start()


def require_32_bit(who: str) -> None:
    """Raises ConfigError, which names `who` did it, if numbers of jax have 64 bit here."""
    if jax.config.read("jax_enable_x64"):
        raise ConfigError(
            f"jax_enable_x64: turned on by {who}; tasks and policies compute with 32 bit, so turn "
            'it off: jax.config.update("jax_enable_x64", False), or no JAX_ENABLE_X64'
        )


def host_sharding() -> Sharding | None:
    """Where a GPU should put what the host reads next: pinned host memory; None on a CPU.

    The program then ends with one transfer at full speed. Reading a device array instead goes
    through pageable memory: 0.9 ms against 0.07 ms for 0.11M float32 on an H200.
    """
    device = jax.local_devices()[0]
    if device.platform != "gpu":
        return None
    return SingleDeviceSharding(device, memory_kind="pinned_host")


def memory_limit_bytes() -> int | None:
    """The most memory that this process's device gives it; None where that is unknown."""
    return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")


def describe_device() -> dict[str, Any]:
    """Platform, kind and peak memory of this process's device, for `summary.json`."""
    device = jax.local_devices()[0]
    peak = (device.memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "platform": device.platform,
        "kind": device.device_kind,
        "peak_memory_mib": (peak + sum(other() for other in PEAKS_BESIDE_JAX)) / 2**20
        if peak
        else None,
        # All that there is where the device does not count, as on the CPU.
        "peak_host_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
    }

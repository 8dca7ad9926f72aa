"""What a summary says of the device that a GMI ran on."""

from __future__ import annotations

import resource
from typing import Any

import jax


def describe_device() -> dict[str, Any]:
    """Platform, kind and peak memory of this process's device, for `summary.json`."""
    device = jax.local_devices()[0]
    peak = (device.memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "platform": device.platform,
        "kind": device.device_kind,
        "peak_memory_mib": peak / 2**20 if peak else None,
        # All that there is where the device does not count, as on the CPU.
        "peak_host_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
    }

"""Where programs put what the host reads."""

from __future__ import annotations

import jax
from jax.sharding import Sharding, SingleDeviceSharding


def host_sharding() -> Sharding | None:
    """Where a GPU should put what the host reads next: pinned host memory; None on a CPU.

    The program then ends with one transfer at full speed. Reading a device array instead goes
    through pageable memory: 0.9 ms against 0.07 ms for 0.11M float32 on an H200.
    """
    device = jax.local_devices()[0]
    if device.platform != "gpu":
        return None
    return SingleDeviceSharding(device, memory_kind="pinned_host")

"""Main of the child that asks jax what it sees: `python -m gmijax.workers.jax_probe`.

Started by `gmijax.control.system_info`, which must not load jax itself. Writes one line of JSON.
"""

from __future__ import annotations

import json
import sys


def main() -> int:
    """Writes platform and devices; an exception of jax is left to end the process."""
    import jax
    import jax.numpy as jnp

    devices = jax.devices()
    # A device that is listed may still refuse to compute.
    jnp.ones(8).sum().block_until_ready()
    seen = {
        "platform": devices[0].platform,
        "devices": [str(device.device_kind) for device in devices],
    }
    sys.stdout.write(json.dumps(seen) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Backend `cpu`: GPUs are virtual, a GMI is a process with CPU cores of its own.

There is nothing to set up: the cores are part of the plan, and GMIs pin themselves to them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from gmijax.supervise.backends.backend import Backend
from gmijax.version import versions_of

NO_FUSION_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
"""Physics of long kinematic chains runs up to a thousand times slower with the emitters."""

_FIRST_JAXLIB_WITHOUT_FLAG = (0, 11, 1)
"""From here on XLA ends the process when it meets the flag, as with any unknown one."""


class CpuBackend(Backend):
    """Gives GMIs the XLA flags that the installed jaxlib understands."""

    def environment(self, gmi: int) -> Mapping[str, str]:
        """See `Backend`."""
        del gmi
        # Read from the package's metadata: the controller must not import jax.
        version = versions_of(["jaxlib"])["jaxlib"]
        numbers = re.findall(r"\d+", version)[:3] if version else []
        return cpu_environment(tuple(map(int, numbers)) or None)


def cpu_environment(jaxlib: tuple[int, ...] | None) -> dict[str, str]:
    """The variables for a jaxlib version; none where jaxlib is not installed."""
    accepted = jaxlib is not None and jaxlib < _FIRST_JAXLIB_WITHOUT_FLAG
    return {"XLA_FLAGS": NO_FUSION_EMITTERS} if accepted else {}

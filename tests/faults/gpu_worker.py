"""Main of a GMI that runs out of GPU memory or gets stuck, once, when a file asks it to.

`GMIJAX_FAULT_DIR` names a folder; GMI k looks for `oom_k` and `stuck_k` in it after an iteration,
removes what it finds, and does it.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

from gmijax.supervise.child import ChildLink
from gmijax.workers import training_worker

_beat = ChildLink.beat


def _beat_and_fail(link: ChildLink, state: Any, iteration: int) -> None:
    _beat(link, state, iteration)
    folder = Path(os.environ["GMIJAX_FAULT_DIR"])
    for kind in ("oom", "stuck"):
        asked = folder / f"{kind}_{link.gmi}"
        if state == "running" and asked.exists():
            asked.unlink()
            if kind == "stuck":
                time.sleep(1e6)
            import jax.numpy as jnp

            jnp.ones(2**40).block_until_ready()


if __name__ == "__main__":
    setattr(ChildLink, "beat", _beat_and_fail)  # noqa: B010
    sys.exit(training_worker.main())

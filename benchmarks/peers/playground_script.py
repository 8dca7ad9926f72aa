"""Playground's own training script: `python -m benchmarks.peers.playground_script FLAGS`.

Flags are those of `train-jax-ppo`. It is left as it is, but for a function that Brax 0.14.2 calls
and JAX 0.10 has no more, and for where robot models are looked for.
"""

from __future__ import annotations

import importlib
import sys

import jax

from benchmarks.peers.brax_ppo import replicated
from gmijax.sim.adapters.playground_package import import_playground


def main() -> None:
    """Trains; ends the process."""
    jax.device_put_replicated = replicated
    import_playground()
    importlib.import_module("learning.train_jax_ppo").run()


if __name__ == "__main__":
    sys.exit(main())

"""Options of `jax.jit` that make physics on a CPU compile and run faster, where they exist."""

from __future__ import annotations

import jax

# XLA dropped the option with jaxlib 0.11.1, and refuses options that it does not know.
_HAS_OPTION = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11, 1)

CPU_OPTIONS = {"xla_cpu_use_fusion_emitters": False} if _HAS_OPTION else None

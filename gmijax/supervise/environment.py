"""Environment variables of a GMI: a function of the plan and the installed jaxlib.

They must be set before the GMI imports jax; that is why every GMI is a fresh interpreter.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from gmijax.machine.jax_settings import without_breaking
from gmijax.machine.opengl import GL_VARIABLE, NO_OPENGL
from gmijax.machine.xla_on_cpu import POOL, XLA_FLAGS, flags_on_cpu, pool_on_cpu
from gmijax.partition.plan import Allocation, Plan
from gmijax.supervise.child import ENV_CPUS, ENV_GMI

# The old and the new name of one JAX setting; JAX refuses to start when both are set.
_MEMORY_FRACTION, _OLD_MEMORY_FRACTION = (
    "XLA_CLIENT_MEM_FRACTION",
    "XLA_PYTHON_CLIENT_MEM_FRACTION",
)
_SM_PERCENT = "CUDA_MPS_ACTIVE_THREAD_PERCENTAGE"
NCCL_INTERFACE: Final = "NCCL_SOCKET_IFNAME"
"""Where NCCL listens and connects; not what InfiniBand and the like send by."""

COMPILATION_CACHE: Final = "JAX_COMPILATION_CACHE_DIR"
_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def gmi_environment(
    plan: Plan,
    gmi: int,
    inherited: Mapping[str, str],
    cache_dir: Path,
    backend_environment: Mapping[str, str],
) -> dict[str, str]:
    """All environment variables of one GMI.

    The user's `XLA_FLAGS`, compilation cache and thread limits are kept; what defines the GMI's
    share (devices, memory fraction, SM cap) is overwritten. Settings of jax with which nothing
    works are left out.

    Args:
      plan: the plan.
      gmi: id of the GMI.
      inherited: the controller's own variables.
      cache_dir: compilation cache, unless the user has set one.
      backend_environment: what the backend adds.
    """
    allocation = plan.allocations[gmi]
    dropped = (_OLD_MEMORY_FRACTION, _MEMORY_FRACTION, _SM_PERCENT)
    kept = {k: value for k, value in without_breaking(inherited).items() if k not in dropped}
    # One thread beside a GPU: there the host only moves small arrays, and the GMIs of all GPUs
    # share the cores.
    defaults: dict[str, str] = {COMPILATION_CACHE: str(cache_dir)}
    for name in _THREAD_LIMITS:
        defaults[name] = str(len(allocation.cpus) or 1)
    if plan.backend == "cpu":
        own = _cpu(allocation, inherited.get(XLA_FLAGS, ""))
    else:
        own = _gpu(allocation)
        if plan.inter != "nccl":
            # All of a ring are on this host, and NCCL's sockets are open to any client.
            defaults[NCCL_INTERFACE] = "lo"
    return {**defaults, **kept, **own, **_common(allocation), **backend_environment}


def _common(allocation: Allocation) -> dict[str, str]:
    return {
        ENV_GMI: str(allocation.gmi),
        ENV_CPUS: ",".join(map(str, allocation.cpus)),
        "PYTHONUNBUFFERED": "1",
        # Every program is cached, also quick ones: all GMIs compile the same ones.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        # NVLink multicast is unsafe on hosts that are shared with others.
        "NCCL_NVLS_ENABLE": "0",
        GL_VARIABLE: NO_OPENGL,
    }


def _cpu(allocation: Allocation, users_flags: str) -> dict[str, str]:
    pool = pool_on_cpu(len(allocation.cpus))
    variables = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "", POOL: str(pool)}
    if flags := flags_on_cpu(users_flags):
        variables[XLA_FLAGS] = flags
    return variables


def _gpu(allocation: Allocation) -> dict[str, str]:
    variables = {"JAX_PLATFORMS": "cuda", "CUDA_VISIBLE_DEVICES": allocation.device}
    if allocation.memory_fraction is not None:
        variables[_MEMORY_FRACTION] = f"{allocation.memory_fraction:g}"
    if allocation.sm_percent is not None:
        variables[_SM_PERCENT] = f"{allocation.sm_percent:g}"
    return variables

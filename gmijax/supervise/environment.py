"""Environment variables of a GMI: a pure function of the plan.

They must be set before the GMI imports jax; that is why every GMI is a fresh interpreter.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from gmijax.partition.plan import Plan, Slice
from gmijax.supervise.child import ENV_CPUS, ENV_GMI, ENV_WAITS

# The old and the new name of one JAX setting; JAX refuses to start when both are set.
_MEMORY_FRACTION, _OLD_MEMORY_FRACTION = (
    "XLA_CLIENT_MEM_FRACTION",
    "XLA_PYTHON_CLIENT_MEM_FRACTION",
)
_XLA_FLAGS = "XLA_FLAGS"
_SM_PERCENT = "CUDA_MPS_ACTIVE_THREAD_PERCENTAGE"
_PRIORITY = "CUDA_MPS_CLIENT_PRIORITY"
_PRIORITIES = {"normal": "0", "below_normal": "1"}
COMPILATION_CACHE: Final = "JAX_COMPILATION_CACHE_DIR"
_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_SMALLEST_POOL = 4

_NCCL_INTERFACE = "NCCL_SOCKET_IFNAME"


def gmi_environment(
    plan: Plan,
    gmi: int,
    inherited: Mapping[str, str],
    cache_dir: Path,
    backend_environment: Mapping[str, str],
) -> dict[str, str]:
    """All environment variables of one GMI.

    The user's `XLA_FLAGS`, compilation cache and thread limits are kept; what defines the GMI's
    share (devices, memory fraction, SM cap) is overwritten.

    Args:
      plan: the plan.
      gmi: id of the GMI.
      inherited: the controller's own variables.
      cache_dir: compilation cache, unless the user has set one.
      backend_environment: what the backend adds; its `XLA_FLAGS` are appended to the user's.
    """
    share = plan.slices[gmi]
    environment = dict(inherited)
    for name in (_OLD_MEMORY_FRACTION, _MEMORY_FRACTION, _SM_PERCENT):
        environment.pop(name, None)
    environment.update(_cpu(share) if plan.backend == "cpu" else _gpu(share))
    environment.update(_common(share))
    environment.setdefault(COMPILATION_CACHE, str(cache_dir))
    for name in _THREAD_LIMITS:
        # One thread beside a GPU: there the host only moves small arrays, and the GMIs of all
        # GPUs share the cores.
        environment.setdefault(name, str(len(share.cpus) or 1))
    added = dict(backend_environment)
    flags = extend_xla_flags(environment.get(_XLA_FLAGS, ""), added.pop(_XLA_FLAGS, ""))
    environment.pop(ENV_WAITS, None)  # Of the job that this one may be started from.
    if plan.backend != "cpu":
        # All GMIs are on this host, and NCCL's sockets are open to whoever reaches them.
        environment.setdefault(_NCCL_INTERFACE, "lo")
    if flags:
        environment[_XLA_FLAGS] = flags
    return {**environment, **added}


def extend_xla_flags(users: str, added: str) -> str:
    """The user's flags and those of `added` that the user has not set."""
    taken = {flag.partition("=")[0] for flag in users.split()}
    more = [flag for flag in added.split() if flag.partition("=")[0] not in taken]
    return " ".join([*users.split(), *more])


def _common(share: Slice) -> dict[str, str]:
    return {
        ENV_GMI: str(share.gmi),
        ENV_CPUS: ",".join(map(str, share.cpus)),
        "PYTHONUNBUFFERED": "1",
        # Every program is cached, also quick ones: all GMIs compile the same ones.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        # NVLink multicast is unsafe on hosts that are shared with others.
        "NCCL_NVLS_ENABLE": "0",
    }


def _cpu(share: Slice) -> dict[str, str]:
    cores = len(share.cpus)
    # XLA's pool of exactly two threads can hang on batched physics, so two and three cores
    # get a larger one.
    pool = 1 if cores == 1 else max(_SMALLEST_POOL, cores)
    return {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": "", "PJRT_NPROC": str(pool)}


def _gpu(share: Slice) -> dict[str, str]:
    variables = {"JAX_PLATFORMS": "cuda", "CUDA_VISIBLE_DEVICES": share.device}
    if share.memory_fraction is not None:
        variables[_MEMORY_FRACTION] = f"{share.memory_fraction:g}"
    if share.sm_percent is not None:
        variables[_SM_PERCENT] = f"{share.sm_percent:g}"
    if share.priority is not None:
        variables[_PRIORITY] = _PRIORITIES[share.priority]
    return variables

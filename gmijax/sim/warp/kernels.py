"""Kernels of MuJoCo Warp that are the same for all models, compiled at the same time."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from typing import Any

import jax
import mujoco

PACKAGE = "mujoco.mjx.third_party.mujoco_warp._src"
_OF_ALL = ("constraint", "forward", "passive", "smooth", "solver", "support")
_IMPLICIT = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def compile_kernels(mj_model: mujoco.MjModel) -> None:
    """Compiles those that a step of this model launches, or loads them from Warp's cache.

    Warp would compile each module when one of its kernels is launched first, one after the other.
    So it does with kernels that are generated for a model. Where JAX has no GPU, nothing is done.
    """
    if jax.default_backend() != "gpu":
        return
    importlib.import_module(PACKAGE.rpartition(".")[0])  # Registers its kernels.
    warp: Any = importlib.import_module("warp")
    modules = [warp.get_module(f"{PACKAGE}.{name}") for name in modules_of(mj_model)]
    num_workers = min(len(modules), len(os.sched_getaffinity(0)))
    warp.force_load(warp.get_cuda_device(), modules, max_workers=num_workers)


def modules_of(mj_model: mujoco.MjModel) -> Iterator[str]:
    """Modules of the package with kernels of a step."""
    yield from _OF_ALL
    if mj_model.nsensor:
        yield "sensor"
    if mj_model.opt.integrator in _IMPLICIT:
        yield "derivative"

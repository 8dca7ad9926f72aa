"""Kernels of MuJoCo Warp that are the same for every model, compiled at the same time."""

from __future__ import annotations

import importlib
import os
from typing import Any

PACKAGE = "mujoco.mjx.third_party.mujoco_warp._src"
MODULES = ("constraint", "forward", "passive", "sensor", "smooth", "solver", "support")
"""Of the package, with kernels of a step. Others are made for a model when it is stepped."""


def compile_kernels() -> None:
    """Compiles and loads these kernels, or loads them from Warp's cache; without a GPU nothing.

    Warp would compile each module when one of its kernels is launched first, one after the other.
    """
    importlib.import_module(PACKAGE.rpartition(".")[0])  # Registers its kernels.
    warp: Any = importlib.import_module("warp")
    if warp.is_cuda_available():
        warp.force_load(
            warp.get_cuda_device(),
            [warp.get_module(f"{PACKAGE}.{name}") for name in MODULES],
            max_workers=min(len(MODULES), len(os.sched_getaffinity(0))),
        )

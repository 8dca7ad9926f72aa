"""Which kernels of MuJoCo Warp are compiled at once, and where."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco.mjx
import pytest

from gmijax.sim.warp.kernels import MODULES, PACKAGE, compile_kernels


@pytest.mark.parametrize(("has_gpu", "cores"), [(True, 2), (True, 64), (False, 2)])
def test_kernels_are_compiled_on_all_cores_where_there_is_a_gpu(
    has_gpu: bool, cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[tuple[Any, ...]] = []
    warp: Any = ModuleType("warp")
    warp.is_cuda_available = lambda: has_gpu
    warp.get_cuda_device = lambda: "cuda:0"
    warp.get_module = lambda name: name.removeprefix(f"{PACKAGE}.")
    warp.force_load = lambda device, modules, max_workers: loaded.append(
        (device, tuple(modules), max_workers)
    )
    monkeypatch.setitem(sys.modules, "warp", warp)
    kernels = PACKAGE.removesuffix("._src")
    monkeypatch.setitem(sys.modules, kernels, ModuleType(kernels))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)))
    compile_kernels()
    assert loaded == ([("cuda:0", MODULES, min(cores, 7))] if has_gpu else [])


@pytest.mark.parametrize("name", MODULES)
def test_every_module_is_one_of_mujocos_with_kernels(name: str) -> None:
    folder = Path(mujoco.mjx.__file__).parent / "third_party" / "mujoco_warp" / "_src"
    assert f"{PACKAGE}.{name}" == f"mujoco.mjx.third_party.mujoco_warp._src.{name}"
    assert "\n@wp.kernel" in (folder / f"{name}.py").read_text()

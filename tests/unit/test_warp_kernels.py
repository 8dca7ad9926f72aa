"""Which kernels of MuJoCo Warp are compiled at once, and where."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import mujoco.mjx
import pytest

from gmijax.sim.warp.kernels import PACKAGE, compile_kernels, modules_of

PENDULUM = """<mujoco><option integrator="{}"/><worldbody><body name="arm"><joint name="hinge"/>
<geom size="0.1"/></body></worldbody><sensor>{}</sensor></mujoco>"""
SENSOR = '<jointpos joint="hinge"/>'
ALL = ["constraint", "forward", "passive", "smooth", "solver", "support"]


def pendulum(integrator: str = "Euler", sensor: str = "") -> Any:
    return mujoco.MjModel.from_xml_string(PENDULUM.format(integrator, sensor))


@pytest.mark.parametrize(
    ("integrator", "sensor", "more"),
    [
        ("Euler", "", []),
        ("implicitfast", "", ["derivative"]),
        ("implicit", SENSOR, ["sensor", "derivative"]),
    ],
)
def test_a_model_needs_modules_of_its_kind(integrator: str, sensor: str, more: list[str]) -> None:
    names = list(modules_of(pendulum(integrator, sensor)))
    assert names == ALL + more
    folder = Path(mujoco.mjx.__file__).parent / "third_party" / "mujoco_warp" / "_src"
    assert f"{PACKAGE}.x" == "mujoco.mjx.third_party.mujoco_warp._src.x"
    for name in names:
        assert "\n@wp.kernel" in (folder / f"{name}.py").read_text()


@pytest.mark.parametrize(("backend", "cores"), [("gpu", 2), ("gpu", 64), ("cpu", 2)])
def test_modules_are_compiled_on_all_cores_where_jax_has_a_gpu(
    backend: str, cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[Any] = []
    warp: Any = ModuleType("warp")
    warp.get_cuda_device = lambda: "cuda:0"
    warp.get_module = lambda name: name.removeprefix(f"{PACKAGE}.")
    warp.force_load = lambda device, modules, max_workers: loaded.append(
        (device, modules, max_workers)
    )
    monkeypatch.setitem(sys.modules, "warp", warp)
    kernels = PACKAGE.removesuffix("._src")
    monkeypatch.setitem(sys.modules, kernels, ModuleType(kernels))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)))
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    compile_kernels(pendulum())
    assert loaded == ([("cuda:0", ALL, min(cores, 6))] if backend == "gpu" else [])

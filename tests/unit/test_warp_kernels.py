"""Which kernels of MuJoCo Warp are compiled at once, and where; Warp is faked."""

from __future__ import annotations

import os
import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from gmijax.sim.warp import kernels
from gmijax.sim.warp.kernels import Variant, compile_kernels, launched_by

ANY_MODEL: Any = None
BROKEN = "broken"
"""A module that cannot be compiled."""


class Warp:
    """What of Warp is used, with one kernel in each module.

    Attributes:
      compiled: variants.
      launched: names of kernels that ran.
      threads: those that have compiled.
      at_once: has so many compile at the same time.
    """

    def __init__(self) -> None:
        self.compiled: list[Variant] = []
        self.launched: list[str] = []
        self.threads: set[int] = set()
        self.at_once = threading.Barrier(1)
        fake = self

        class Module:
            def __init__(self, name: str) -> None:
                self.name, self.options = name, {"block_dim": 32}

            def load(self, device: Any, block_dim: int | None = None) -> Any:
                if self.name == BROKEN:
                    raise RuntimeError("no such instruction")
                fake.at_once.wait(30.0)
                fake.compiled.append(Variant(self.name, block_dim or self.options["block_dim"]))
                fake.threads.add(threading.get_ident())
                return object()

        self.Module = Module
        self.utils = SimpleNamespace(
            segmented_sort_pairs=self.sort, radix_sort_pairs=self.sort, array_scan=self.sort
        )
        self.modules: dict[str, Any] = {}

    def kernel(self, name: str) -> Any:
        return SimpleNamespace(module=self.modules.setdefault(name, self.Module(name)))

    def launch(self, name: str, block_dim: int = 256) -> None:
        if self.kernel(name).module.load("cuda:0", block_dim):
            self.launched.append(name)

    def sort(self) -> None:
        self.launched.append("sort")

    def capture_while(self, condition: bool, while_body: Any, stream: Any = None) -> None:
        while condition:
            raise AssertionError("nobody has computed the condition")

    def capture_if(self, condition: bool, on_true: Any = None, on_false: Any = None) -> None:
        (on_true if condition else on_false)()

    def get_suggested_block_size(self, kernel: Any) -> tuple[int, int]:
        return (128, 1) if kernel.module.load("cuda:0") else (0, 0)

    def get_cuda_device(self) -> str:
        return "cuda:0"

    def ScopedDevice(self, device: str) -> Any:  # noqa: N802
        return nullcontext(device)

    def force_load(
        self, device: str, modules: list[Any], *, block_dim: int | None, max_workers: int
    ) -> None:
        assert (device, max_workers) == ("cuda:0", 0)
        for module in modules:
            module.load(device, block_dim)


@pytest.fixture
def warp(monkeypatch: pytest.MonkeyPatch) -> Warp:
    fake = Warp()

    def step(*_: Any) -> None:
        fake.launch("smooth")
        fake.launch("smooth", 32)
        fake.capture_if(False, on_true=lambda: fake.launch("contacts"), on_false=None)
        size, count = fake.get_suggested_block_size(fake.kernel("rows"))
        fake.launch("rows", size // count)
        fake.utils.array_scan()
        fake.capture_while(True, while_body=lambda: fake.launch("solver"))
        fake.launch("smooth")

    package = SimpleNamespace(put_model=lambda model: model, make_data=lambda _: None, step=step)
    loaded = SimpleNamespace(warp=fake, mujoco_warp=package)
    monkeypatch.setattr(kernels, "mjx_warp", loaded)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    return fake


STEP = [
    *(Variant("smooth", 256), Variant("smooth", 32), Variant("contacts", 256)),
    *(Variant("rows", 32), Variant("rows", 1), Variant("solver", 256)),
]


def test_a_step_is_noted_and_nothing_of_it_is_done(warp: Warp) -> None:
    found = launched_by(lambda: kernels.mjx_warp.mujoco_warp.step())
    assert [(module.name, block_dim) for module, block_dim in found] == STEP
    assert (warp.compiled, warp.launched) == ([], [])
    # Afterwards Warp does what it did before.
    warp.launch("smooth")
    warp.utils.array_scan()
    assert (warp.compiled, warp.launched) == ([Variant("smooth", 256)], ["smooth", "sort"])
    with pytest.raises(AssertionError, match="nobody has computed"):
        warp.capture_while(True, while_body=None)


def test_what_a_step_launches_before_it_fails_counts(warp: Warp) -> None:
    def step() -> None:
        warp.launch("smooth")
        raise ValueError("wants what a kernel has computed")

    assert [variant.module.name for variant in launched_by(step)] == ["smooth"]
    warp.launch("smooth")
    assert warp.launched == ["smooth"]


def test_other_threads_launch_as_ever(warp: Warp) -> None:
    def step() -> None:
        other = threading.Thread(target=warp.launch, args=("theirs",))
        other.start()
        other.join()

    assert launched_by(step) == []
    assert warp.launched == ["theirs"]


@pytest.mark.parametrize(("cores", "at_once"), [(1, 1), (3, 3), (64, len(STEP))])
def test_all_are_compiled_before_the_first_is_launched(
    warp: Warp, cores: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    warp.at_once = threading.Barrier(at_once)
    compile_kernels(ANY_MODEL)
    assert sorted(map(str, warp.compiled)) == sorted(map(str, STEP))
    assert len(warp.threads) == at_once
    assert threading.get_ident() not in warp.threads
    assert warp.launched == []


def test_a_kernel_that_cannot_be_compiled_says_so_when_it_is_launched(
    warp: Warp, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = kernels.mjx_warp.mujoco_warp
    monkeypatch.setattr(package, "step", lambda *_: [warp.launch(BROKEN), warp.launch("smooth")])
    compile_kernels(ANY_MODEL)
    assert warp.compiled == [Variant("smooth", 256)]
    with pytest.raises(RuntimeError, match="no such instruction"):
        warp.launch(BROKEN)


def test_a_model_that_warp_cannot_take_here_is_compiled_as_it_runs(
    warp: Warp, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory(_: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(kernels.mjx_warp.mujoco_warp, "make_data", no_memory)
    compile_kernels(ANY_MODEL)
    assert warp.compiled == []


def test_a_model_that_launches_nothing(warp: Warp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels.mjx_warp.mujoco_warp, "step", lambda *_: None)
    compile_kernels(ANY_MODEL)
    assert warp.compiled == []


BALL = """<mujoco><option integrator="implicitfast"/><worldbody>
<geom type="plane" size="1 1 1"/><body pos="0 0 0.1"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>"""


def test_a_step_of_mujoco_warp_loads_what_was_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    real = pytest.importorskip("warp")
    package = kernels.mjx_warp.mujoco_warp
    mj_model, loaded = mujoco.MjModel.from_xml_string(BALL), dict[Variant, None]()
    load = real.Module.load

    def noted(module: Any, device: Any, block_dim: int | None = None) -> Any:
        loaded[Variant(module, block_dim or module.options["block_dim"])] = None
        return load(module, device, block_dim)

    with real.ScopedDevice("cpu"):
        model, data = package.put_model(mj_model), package.make_data(mj_model)
        before = data.qvel.numpy().copy()
        found = launched_by(lambda: package.step(model, data))
        assert np.array_equal(data.qvel.numpy(), before)
        monkeypatch.setattr(real.Module, "load", noted)
        package.step(model, data)
    assert not np.array_equal(data.qvel.numpy(), before)
    assert loaded
    assert set(loaded) <= set(found)


def test_without_a_gpu_nothing_is_compiled(warp: Warp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    compile_kernels(ANY_MODEL)
    assert warp.compiled == []

"""Kernels of MuJoCo Warp, nearly all that a step of a model launches, compiled at once."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import jax
import mujoco
from mujoco.mjx import warp as mjx_warp

_ANY_SIZE = (64, 64)
"""Threads of a block and number of blocks, instead of Warp's own, which need a compiled kernel."""

_ONE_AT_A_TIME = threading.Lock()
"""Held while functions of Warp are replaced."""


class Variant(NamedTuple):
    """Kernels that Warp compiles together.

    Attributes:
      module: Warp's; many kernels of a model have one of their own.
      block_dim: threads of a block, for which they are compiled.
    """

    module: Any
    block_dim: int


def compile_kernels(mj_model: mujoco.MjModel) -> None:
    """Compiles those that a step of this model launches, or loads them from Warp's cache.

    Warp would compile them when each is launched first, one after the other, and still does so
    with what is missed here. Where JAX has no GPU, nothing is done.
    """
    if jax.default_backend() != "gpu":
        return
    warp, mujoco_warp = mjx_warp.warp, mjx_warp.mujoco_warp
    device, variants = warp.get_cuda_device(), list[Variant]()
    with suppress(Exception), warp.ScopedDevice(device):
        model, data = mujoco_warp.put_model(mj_model), mujoco_warp.make_data(mj_model)
        variants = launched_by(lambda: mujoco_warp.step(model, data))

    def load(variant: Variant) -> None:
        with suppress(Exception):  # A launch of the kernel raises it again.
            warp.force_load(device, [variant.module], block_dim=variant.block_dim, max_workers=0)

    num_threads = max(1, min(len(variants), len(os.sched_getaffinity(0))))
    with ThreadPoolExecutor(num_threads) as threads:
        list(threads.map(load, variants))


def launched_by(step: Callable[[], None]) -> list[Variant]:
    """What a step would launch. No kernel runs; what its arrays hold afterwards means nothing.

    Both sides of a condition count, and a loop whose end is computed is gone through once.
    """
    found: dict[Variant, None] = {}
    with _ONE_AT_A_TIME, _noting(found), suppress(Exception):  # Some are better than none.
        step()
    return list(found)


@contextmanager
def _noting(found: dict[Variant, None]) -> Iterator[None]:
    """Has Warp note what this thread would load or launch."""
    warp = mjx_warp.warp

    def load(module: Any, device: Any, block_dim: int | None = None, **_: Any) -> None:
        own = module.options["block_dim"]
        found[Variant(module, own if block_dim is None else block_dim)] = None
        # A launch does nothing where this returns None.

    def capture_while(_: Any, while_body: Any, stream: Any = None, **given: Any) -> None:
        while_body(**given)

    def capture_if(
        _: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **given: Any
    ) -> None:
        for side in filter(callable, (on_true, on_false)):
            side(**given)

    def get_suggested_block_size(kernel: Any, device: Any = None) -> tuple[int, int]:
        kernel.module.load(device)
        return _ANY_SIZE

    def nothing(*_: Any, **__: Any) -> None:
        """Sorts and scans would read arrays that were not computed."""

    with (
        _replaced(warp.Module, load=load),
        _replaced(
            warp,
            capture_while=capture_while,
            capture_if=capture_if,
            get_suggested_block_size=get_suggested_block_size,
        ),
        _replaced(
            warp.utils, segmented_sort_pairs=nothing, radix_sort_pairs=nothing, array_scan=nothing
        ),
    ):
        yield


@contextmanager
def _replaced(owner: Any, **others: Callable[..., Any]) -> Iterator[None]:
    """Replaces functions of `owner`, in this thread."""
    own = {name: getattr(owner, name) for name in others}
    thread = threading.get_ident()

    def chosen(name: str) -> Callable[..., Any]:
        def call(*args: Any, **given: Any) -> Any:
            is_here = threading.get_ident() == thread
            return (others if is_here else own)[name](*args, **given)

        return call

    for name in others:
        setattr(owner, name, chosen(name))
    try:
        yield
    finally:
        for name, function in own.items():
            setattr(owner, name, function)

"""Stands for Warp and MuJoCo Warp on a GPU: arrays are numpy's, a graph is a list of calls."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np


class Device:
    """Cannot be a key, as Warp's."""

    __hash__ = None  # type: ignore[assignment]
    alias, is_cuda, is_mempool_supported = "cuda:0", True, True


DEVICE = Device()


class FakeArray:
    """`values` in memory of numpy."""

    device = DEVICE
    dtype = np.float32

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    @property
    def size(self) -> int:
        return self.values.size

    @property
    def ptr(self) -> int:
        return int(self.values.ctypes.data)

    def __getitem__(self, where: slice) -> FakeArray:
        return FakeArray(self.values[where])

    def zero_(self) -> None:
        self.values[...] = 0.0


class FakeWarp:
    """What `gmijax.sim.warp` uses of Warp and MuJoCo Warp.

    A physics step adds the controls to the positions and counts itself in `sensordata`; in a
    capture it only becomes part of the graph.
    """

    def __init__(self) -> None:
        self.steps, self.launches = 0, 0
        self.made: list[dict[str, Any]] = []
        self._graph: list[Callable[[], None]] | None = None
        self.warp = SimpleNamespace(
            zeros=lambda size, dtype: FakeArray(np.zeros(size, np.float32)),
            array=self._view,
            copy=self._copy,
            ScopedCapture=self._capture,
            capture_launch=self._launch,
            get_mempool_used_mem_high=lambda alias: {"cuda:0": 1 << 20}[alias],
            types=SimpleNamespace(type_size_in_bytes=lambda dtype: 4),
        )
        self.mujoco_warp = SimpleNamespace(
            put_model=self._put_model, make_data=self._make_data, step=self._step
        )

    def _view(self, *, ptr: int, dtype: Any, shape: tuple[int, ...], device: Any) -> FakeArray:
        assert device is DEVICE
        floats = int(np.prod(shape))
        memory = ctypes.cast(ptr, ctypes.POINTER(ctypes.c_float))
        return FakeArray(np.ctypeslib.as_array(memory, (floats,)).reshape(shape))

    def _copy(self, dest: FakeArray, source: FakeArray) -> None:
        dest.values[...] = source.values

    @contextmanager
    def _capture(self) -> Iterator[SimpleNamespace]:
        self._graph, capture = [], SimpleNamespace(graph=None)
        yield capture
        capture.graph, self._graph = self._graph, None

    def _launch(self, graph: list[Callable[[], None]]) -> None:
        self.launches += 1
        for call in graph:
            call()

    def _put_model(self, mj_model: Any, batch_sizes: dict[str, int]) -> SimpleNamespace:
        self.made.append({"batch_sizes": batch_sizes})
        rows = batch_sizes.get("body_mass", 1)
        mass = FakeArray(np.full((rows, 2), 7.0, np.float32))
        return SimpleNamespace(body_mass=mass, opt=SimpleNamespace())

    def _make_data(self, mj_model: Any, nworld: int, **sizes: int) -> SimpleNamespace:
        self.made[-1] |= {"nworld": nworld, **sizes}
        names = ("ctrl", "qpos", "qvel", "qacc_warmstart", "sensordata")
        arrays = {name: FakeArray(np.ones((nworld, 2), np.float32)) for name in names}
        each = {name: FakeArray(np.ones(nworld, np.float32)) for name in ("time", "overflow")}
        jacobian = SimpleNamespace(J=FakeArray(np.ones((nworld, 3), np.float32)))
        return SimpleNamespace(**arrays, **each, efc=jacobian)

    def _step(self, model: SimpleNamespace, data: SimpleNamespace) -> None:
        def step() -> None:
            self.steps += 1
            data.qpos.values += data.ctrl.values * model.body_mass.values
            data.sensordata.values[...] = self.steps

        step() if self._graph is None else self._graph.append(step)

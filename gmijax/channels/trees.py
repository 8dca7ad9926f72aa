"""Nested Python data as a skeleton and its arrays, and back; without jax.

A skeleton is a pickle in which arrays stand as references. So whatever can be pickled can hold
arrays (dicts, lists, tuples, NamedTuples, dataclasses, what others build of them), arrays travel
as raw bytes, and a process that has no use for jax need not load it. `cloudpickle` knows objects
of classes of a script or a notebook, which no other process finds by name.
"""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Callable, Sequence
from typing import Any

import cloudpickle
import numpy as np
import numpy.typing as npt

from gmijax.channels.pipe import Bytes

_ON_DEVICE = "on device"


def flatten(
    tree: Any, *, scalars: bool = False, put: Callable[[Any], Any] = lambda _: None
) -> tuple[bytes, list[npt.NDArray[Any]]]:
    """Takes the arrays out of `tree`.

    Args:
      tree: nested data with arrays of numpy or jax; those of jax are copied to host memory.
      scalars: count Python floats and scalars of numpy among the arrays.
      put: called first for every object; what it returns, if not None, is sent instead, and
        `unflatten` passes it to its `get`.

    Returns:
      The skeleton and the arrays, C-contiguous, perhaps views of what was flattened.

    Raises:
      TypeError, pickle.PicklingError: something cannot be pickled, e.g. a lock.
    """
    file = io.BytesIO()
    pickler = _TreePickler(file, scalars, put)
    pickler.dump(tree)
    return file.getvalue(), pickler.arrays


def unflatten(
    skeleton: bytes | memoryview,
    buffers: Sequence[Bytes],
    get: Callable[[Any], Any] | None = None,
) -> Any:
    """Inverts `flatten`, of a process of the same job: unpickling runs code.

    The arrays of the tree are views of `buffers`, [number of its bytes] uint8 each; those of jax
    come back as numpy's. `get` inverts `put`.
    """
    return _Unpickler(skeleton, buffers, get).load()


def as_bytes(array: npt.NDArray[Any]) -> Bytes:
    """The memory of a C-contiguous array as [number of its bytes] uint8."""
    # Not memoryview: that does not know the number formats that jax adds to numpy's.
    return array.reshape(-1).view(np.uint8)


def on_host(value: Any) -> npt.NDArray[Any] | None:
    """The numbers of an array of numpy or jax in host memory; None for anything else.

    The only function in which arrays leave a device on their way to another GMI.
    """
    if type(value) is np.ndarray:  # Masked arrays and the like are more than their numbers.
        return value
    jax = sys.modules.get("jax")
    if jax is not None and isinstance(value, jax.Array):
        return np.asarray(value)
    return None


class _TreePickler(cloudpickle.Pickler):
    def __init__(self, file: io.BytesIO, scalars: bool, put: Callable[[Any], Any]) -> None:
        super().__init__(file, protocol=5)
        self.arrays: list[npt.NDArray[Any]] = []
        self._put = put
        self._scalars = (float, np.generic) if scalars else ()

    def persistent_id(self, obj: Any) -> Any:
        if (on_device := self._put(obj)) is not None:
            return _ON_DEVICE, on_device
        array, is_scalar = on_host(obj), False
        if array is None and isinstance(obj, self._scalars):
            array, is_scalar = np.asarray(obj), True
        # Arrays of Python objects are pickled like any other data.
        if array is None or array.dtype.hasobject:
            return None
        self.arrays.append(np.ascontiguousarray(array))
        return len(self.arrays) - 1, array.dtype, array.shape, is_scalar


class _Unpickler(pickle.Unpickler):
    def __init__(
        self,
        skeleton: bytes | memoryview,
        buffers: Sequence[Bytes],
        get: Callable[[Any], Any] | None,
    ) -> None:
        super().__init__(io.BytesIO(skeleton))
        self._buffers = buffers
        self._get = get

    def persistent_load(self, pid: Any) -> Any:
        if pid[0] == _ON_DEVICE:
            if self._get is None:
                raise pickle.UnpicklingError("an array that stayed on the sender's GPU")
            return self._get(pid[1])
        index, dtype, shape, is_scalar = pid
        array = self._buffers[index].view(dtype).reshape(shape)
        return array[()] if is_scalar else array

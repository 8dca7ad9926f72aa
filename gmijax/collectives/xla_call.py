"""Python functions that a compiled program calls where it gives its work to the device.

XLA's foreign function interface, by ctypes: https://openxla.org/xla/custom_call. A call by name,
unlike `jax.experimental.buffer_callback`, leaves programs in the compilation cache, and costs a
third of its time. Of the interface only what is here is used; that is the same in all versions
with the major number 0.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any, NamedTuple

import jax

MAJOR_VERSION = 0
_METADATA_EXTENSION = 1
_INTERNAL_ERROR = 13
_SCALAR, _INT64 = 3, 5  # A kind of attribute, and a kind of number.
_HEADER: list[Any] = [("struct_size", c_size_t), ("extension", c_void_p)]


class Buffer(NamedTuple):
    """Memory of an argument or a result.

    Attributes:
      address: of its first byte, on the program's device.
      shape: its lengths.
    """

    address: int
    shape: tuple[int, ...]


Call = Callable[[int, list[Buffer], list[Buffer], list[int]], None]
"""`(stream, arguments, results, attributes)`: adds work to a stream of the device; 0 on a CPU,
where the arguments are computed already. Attributes are the `np.int64` that the program was
traced with, in the order of their names."""


class _Version(ctypes.Structure):
    _fields_ = [*_HEADER, ("major", c_int), ("minor", c_int)]


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", c_size_t), ("version", _Version), ("traits", c_uint32)]


class _Extension(ctypes.Structure):
    _fields_ = [
        *(("struct_size", c_size_t), ("type", c_int), ("next", c_void_p)),
        ("metadata", POINTER(_Metadata)),
    ]


class _Buffer(ctypes.Structure):
    _fields_ = [
        *_HEADER,
        *(("dtype", c_int), ("data", c_void_p), ("rank", c_int64), ("dims", POINTER(c_int64))),
    ]


class _Buffers(ctypes.Structure):
    _fields_ = [
        *_HEADER,
        *(("size", c_int64), ("types", c_void_p), ("values", POINTER(POINTER(_Buffer)))),
    ]


class _Scalar(ctypes.Structure):
    _fields_ = [("dtype", c_int), ("value", POINTER(c_int64))]


class _Attributes(ctypes.Structure):
    _fields_ = [
        *(*_HEADER, ("size", c_int64), ("types", POINTER(c_int))),
        *(("names", c_void_p), ("values", POINTER(POINTER(_Scalar)))),
    ]


class _ErrorArguments(ctypes.Structure):
    _fields_ = [*_HEADER, ("message", c_char_p), ("code", c_int)]


class _StreamArguments(ctypes.Structure):
    _fields_ = [*_HEADER, ("context", c_void_p), ("stream", c_void_p)]


class _Api(ctypes.Structure):
    _fields_ = [
        *(*_HEADER, ("version", _Version), ("internal", c_void_p)),
        ("create_error", ctypes.PYFUNCTYPE(c_void_p, POINTER(_ErrorArguments))),
        *(("error_details", c_void_p), ("destroy_error", c_void_p), ("register", c_void_p)),
        ("get_stream", ctypes.PYFUNCTYPE(c_void_p, POINTER(_StreamArguments))),
    ]


class _Frame(ctypes.Structure):
    _fields_ = [
        *(("struct_size", c_size_t), ("extension", POINTER(_Extension)), ("api", POINTER(_Api))),
        *(("context", c_void_p), ("stage", c_int), ("arguments", _Buffers), ("results", _Buffers)),
        ("attributes", _Attributes),
    ]


_HANDLER = ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
_handlers: dict[str, Any] = {}


def register(name: str, call: Call) -> None:
    """Lets programs of this process call `call` as the target `name` of `jax.ffi.ffi_call`.

    For as long as the process lives: XLA has no way to take a name back. A call that raises
    fails the program with the error's words.
    """
    platform = "CUDA" if jax.local_devices()[0].platform == "gpu" else "cpu"

    def handle(frame: Any) -> int | None:
        frame = frame.contents
        if frame.extension and frame.extension.contents.type == _METADATA_EXTENSION:
            return _describe(frame)
        try:
            stream = _stream(frame) if platform == "CUDA" else 0
            arguments, results = _buffers(frame.arguments), _buffers(frame.results)
            call(stream, arguments, results, _integers(frame.attributes))
        except BaseException as error:  # Nothing may be raised into XLA.
            return _error(frame, f"{name}: {error}")
        return None

    _handlers[name] = _HANDLER(handle)  # Kept, because XLA does not.
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_handlers[name]), platform)


def _describe(frame: Any) -> None:
    """Sets the version for which this is made: XLA's own, if what is used is the same there."""
    metadata, version = frame.extension.contents.metadata.contents, frame.api.contents.version
    metadata.version.major, metadata.version.minor = MAJOR_VERSION, version.minor
    metadata.traits = 0


def _buffers(values: Any) -> list[Buffer]:
    buffers = []
    for index in range(values.size):
        buffer = values.values[index].contents
        buffers.append(Buffer(buffer.data or 0, tuple(buffer.dims[: buffer.rank])))
    return buffers


def _integers(attributes: Any) -> list[int]:
    integers = []
    for index in range(attributes.size):
        value = attributes.values[index].contents
        if attributes.types[index] != _SCALAR or value.dtype != _INT64:
            raise TypeError(f"attribute {index} is no int64")
        integers.append(value.value[0])
    return integers


def _stream(frame: Any) -> int:
    asked = _StreamArguments(ctypes.sizeof(_StreamArguments), None, frame.context, None)
    if frame.api.contents.get_stream(asked):
        raise RuntimeError("XLA has no stream for this call")
    return asked.stream or 0


def _error(frame: Any, message: str) -> int:
    asked = _ErrorArguments(
        ctypes.sizeof(_ErrorArguments), None, message.encode(errors="replace"), _INTERNAL_ERROR
    )
    return frame.api.contents.create_error(asked)

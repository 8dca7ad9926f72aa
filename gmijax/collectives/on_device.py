"""What reducers whose buffers stay on the device have in common."""

from __future__ import annotations

import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np

from gmijax.collectives.buffers import require_device_buffer, require_mean_input
from gmijax.collectives.courier import Courier
from gmijax.collectives.host import HostExchange
from gmijax.collectives.interface import DeviceMean, FloatBuffer, Step, TracedStep
from gmijax.collectives.memory import ExchangeBlock
from gmijax.collectives.shared_slots import SharedSlots
from gmijax.collectives.stream_exchange import StreamExchange
from gmijax.collectives.stream_step import StreamStep
from gmijax.collectives.together import Together, WatchedStep
from gmijax.collectives.turns import Turns
from gmijax.errors import CollectiveError, DeviceMemoryUnavailable

T = TypeVar("T")


class OnDevice(ABC):
    """Buffers of the host by way of the device, and what goes through the shared block.

    Whoever inherits has `_host`, this rank's use of that block, and `_num_floats`, P.
    """

    is_device_resident = True
    _host: HostExchange
    _num_floats: int

    @abstractmethod
    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """Returns the mean over ranks of `buffer` [P] float32, see `DeviceReducer`.

        Raises:
          PeerLost: the process of another rank is gone.
          CollectiveTimeout: another rank did not arrive in time.
          CollectiveError: ranks make different calls, or this one is not allowed.
        """
        ...

    def spmd(self, step: Step) -> TracedStep | None:
        """See `DeviceReducer`; None unless somebody knows how."""
        del step
        return None

    def mean(self, buffer: FloatBuffer) -> FloatBuffer:
        """The same for a buffer in host memory, with a copy each way; the result is read-only."""
        require_mean_input(buffer, self._num_floats)
        return np.asarray(self.mean_on_device(jax.device_put(buffer)))

    def all_gather(self, values: FloatBuffer) -> FloatBuffer:
        """See `HostExchange.all_gather`."""
        return self._host.all_gather(values)


class HostPaced(OnDevice):
    """The host takes part in every mean: ranks know only from each other that a slot is written.

    But for steps: where all goes through slots, `_all_slots`, the devices tell each other.

    Attributes:
      exchange_s: see `DeviceReducer`.
    """

    exchange_s = 0.0
    _all_slots: SharedSlots | None = None
    _stream: StreamExchange | None = None
    _together: Together | None = None

    def spmd(self, step: Step) -> TracedStep | None:
        """See `DeviceReducer`; each rank has a program of its own."""
        if self._all_slots is None:
            return None
        if self._stream is None or self._together is None:
            self._together = Together(self._host, Courier("step"), self._num_floats)
            try:
                self._stream = StreamExchange(self._host, self._all_slots, self._together)
            except DeviceMemoryUnavailable as error:
                self._together.close()
                self._all_slots = self._together = None
                warnings.warn(f"{error}; so the host comes between", RuntimeWarning, stacklevel=2)
                return None
        return WatchedStep(StreamStep(self._stream, step), self._together)

    def mean_on_device(self, buffer: jax.Array) -> jax.Array:
        """See `OnDevice.mean_on_device`."""
        require_device_buffer(buffer, self._num_floats)
        if self._together is not None and self._together.is_caught:
            raise CollectiveError(
                f"rank {self._host.rank}: mean before the last step was waited for"
            )
        block, turns = self._host.begin("mean", self._num_floats)
        with turns.explained():
            buffer.block_until_ready()
        started_s = time.monotonic()
        mean = self._exchange(buffer, block, turns)
        turns.end()
        self.exchange_s += time.monotonic() - started_s
        return mean

    def run_on_device(self, program: Callable[[DeviceMean], T]) -> T:
        """See `DeviceReducer`; raises what `mean_on_device` raises."""
        self.exchange_s = 0.0
        return jax.block_until_ready(program(self.mean_on_device))

    def _leave_stream(self) -> bool:
        """Gives back what steps need; whether the device is through with them."""
        if self._together is not None and self._together.is_caught:
            return False
        if self._together is not None:
            self._together.close()
        if self._stream is not None:
            self._stream.close()
        return True

    @abstractmethod
    def _exchange(self, buffer: jax.Array, block: ExchangeBlock, turns: Turns) -> jax.Array:
        """The mean of `buffer`, which is there, in a call that has begun."""
        ...

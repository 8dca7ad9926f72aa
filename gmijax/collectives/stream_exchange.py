"""An exchange through shared slots as work of the device, which a compiled program queues.

No rank stops on the host for it: copies, a flag for the others, waits for their flags and a copy
of what they wrote lie on the program's stream, between what it computes before and after.
"""

from __future__ import annotations

import itertools
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.collectives.device_memory import DeviceQueue
from gmijax.collectives.host import HostExchange
from gmijax.collectives.shared_slots import SharedSlots, agreed
from gmijax.collectives.together import Together
from gmijax.collectives.waits import Fence
from gmijax.collectives.xla_call import Buffer, register
from gmijax.errors import CollectiveError

_FREE = 2**30
_WISH = "exchange on the device's stream"
_serial = itertools.count()


class Order:
    """Whether ranks come to the same exchanges in the same order; without waiting.

    Flags only count. Each rank keeps a word beside its own: how many exchanges it has come to,
    and a checksum of which ones these were, in their order. It looks at the words of those that
    have come as far. Checksums that differ once go on to do so, and who comes last to the end of
    a step finds all others there: so one of two ranks sees it before the next step, whoever is
    ahead.

    Args:
      flags: [pages, line] uint32, see `ExchangeBlock`; the second 64 bits of each line are used.
      rank: this one.
      world_size: K.
    """

    def __init__(self, flags: npt.NDArray[np.uint32], rank: int, world_size: int) -> None:
        self._words = flags.view(np.uint64)[:world_size, 1]
        self._rank = rank
        self._fence = Fence()
        self._count = self._checksum = 0
        self._words[rank] = 0

    def come_to(self, identity: int) -> int | None:
        """Comes to the next exchange; a rank that has come to another one instead, if any."""
        self._count += 1
        self._checksum = zlib.crc32(identity.to_bytes(8, "little"), self._checksum)
        own = (self._count & 0xFFFFFFFF) << 32 | self._checksum
        self._words[self._rank] = own
        self._fence()  # Of two that come at the same time one sees the other.
        for peer, word in enumerate(self._words.tolist()):
            if word != own and word >> 32 == own >> 32:
                return peer
        return None


class StreamExchange:
    """One rank's part; all ranks of the job make theirs together, and try it.

    The slots are used in turn, as by the host: a device that writes one again has seen the flags
    of the exchange in between, which come after all that had been read of the one before.

    Args:
      host: this rank's use of the shared block, with the flags.
      slots: of which all ranks are members.
      together: looks at the peers while the first exchange is tried.

    Raises:
      DeviceMemoryUnavailable: it does not work here; on all ranks alike.
      PeerLost, CollectiveTimeout: as in the first call of a reducer.
    """

    def __init__(self, host: HostExchange, slots: SharedSlots, together: Together) -> None:
        self.rank, self.world_size = host.rank, host.world_size
        self._slots: SharedSlots | None = slots
        self._flags: npt.NDArray[np.uint32] | None = host.flags
        self._queue: DeviceQueue | None = None
        self._order: Order | None = None
        self._kinds: dict[int, str] = {}  # What was traced, by its checksum.
        # The same on all ranks, which make as many: it is part of their programs.
        self._name = f"gmijax_exchange_{next(_serial)}"
        try:
            agreed(host, _WISH, self._open)
            failure = together.settle(self._try)
            agreed(host, _WISH, lambda: _raise(failure))
        except BaseException:
            slots.restart()  # Not all ranks need have come as far.
            if not together.is_caught:
                self.close()
            raise

    def gather(self, values: jax.Array, kind: str) -> jax.Array:
        """[K, n] from `values` [n] float32 of every rank, n <= P; within a program of all.

        XLA may give exchanges that do not need each other to the device in any order. A program
        that another rank gives them in another order fails.

        Args:
          values: of this rank.
          kind: which exchange of its program it is, the same on all ranks, other than the rest.
        """
        if values.dtype != jnp.float32:
            raise CollectiveError(f"rank {self.rank}: exchanges float32, not {values.dtype}")
        if self._slots is None or values.size > self._slots.num_floats:
            room = 0 if self._slots is None else self._slots.num_floats
            raise CollectiveError(f"rank {self.rank}: {values.size} floats, room is for {room}")
        result = jax.ShapeDtypeStruct((self.world_size, values.size), jnp.float32)
        call: Any = jax.ffi.ffi_call(self._name, result, has_side_effect=True)
        identity = zlib.crc32(kind.encode())
        self._kinds[identity] = kind
        return call(values, identity=np.int64(identity))

    def clocked_s(self) -> float:
        """Seconds of exchanges that the device is through with, and that were not told before.

        Each from the time that this rank's values were there to the time that all ranks' were.
        """
        return 0.0 if self._queue is None else self._queue.clocked_s()

    def close(self) -> None:
        """Gives the flags back, once no program is under way; calling it twice is fine."""
        if self._queue is not None:
            self._queue.close()
        # XLA keeps the call for ever, and with it this object.
        self._queue, self._slots, self._flags, self._order = None, None, None, None

    def _open(self) -> bytes:
        assert self._slots is not None
        assert self._flags is not None
        self._queue = self._slots.queue(self._flags)
        self._order = Order(self._flags, self.rank, self.world_size)
        register(self._name, self._call)
        return b""

    def _try(self) -> Exception | None:
        """A first exchange of known numbers; what went wrong with it."""
        assert self._slots is not None
        assert self._flags is not None
        size = self._slots.num_floats
        try:
            found = jax.jit(lambda x: self.gather(x, "trial"))(
                jnp.full(size, self.rank + 1, jnp.float32)
            )
            wanted = np.repeat(np.arange(1, self.world_size + 1)[:, None], size, axis=1)
            is_right = np.array_equal(found, wanted)
            if not is_right and not (self._flags[:, 0] == _FREE).any():  # Another one says why.
                raise RuntimeError("what comes is not what was sent")
        except Exception as error:  # Whatever it is, the host can take part instead.
            self._flags[self.rank, 0] = _FREE  # The others' devices wait for it.
            return error
        self.clocked_s()  # Not a part of the first step.
        return None

    def _call(
        self,
        stream: int,
        arguments: list[Buffer],
        results: list[Buffer],
        attributes: list[int],
    ) -> None:
        if self._slots is None or self._queue is None or self._order is None:
            raise RuntimeError("the exchange is closed")
        (identity,) = attributes
        if (peer := self._order.come_to(identity)) is not None:
            raise RuntimeError(
                f"rank {self.rank} and rank {peer} have come to their exchanges in different "
                f"orders; here it is {self._kinds[identity]}"
            )
        (values,), (gathered,) = arguments, results
        self._slots.gather(self._queue, stream, values.address, gathered.address, values.shape[0])


def _raise(failure: Exception | None) -> bytes:
    if failure is not None:
        raise failure
    return b""

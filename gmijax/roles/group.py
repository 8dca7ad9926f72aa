"""Mean and sum of nested data over some ranks, by messages between them.

Each rank adds up one part of the numbers, in order of rank, and sends the result to all: the
result is bit-identical. Small data go to all ranks at once, which saves one of the two steps.

This takes any data and any group. The mean of many float32 over all ranks goes through the shared
block of the host, which is faster; it takes one length, that of the first such call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from gmijax.channels.mailboxes import COLLECTIVE
from gmijax.channels.messenger import Messenger
from gmijax.channels.trees import as_bytes, flatten, unflatten
from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.interface import FloatBuffer
from gmijax.errors import CollectiveError, CollectiveTimeout, ConfigError

Operation = Literal["mean", "sum"]

AT_ONCE_BYTES: Final = 16384
"""Up to this size numbers go to all ranks at once."""


class _Call(NamedTuple):
    """What a member asks for; it goes with all that it sends."""

    op: str
    size: int
    dtype: str

    def __str__(self) -> str:
        return f"the {self.op} of {self.size} numbers of {self.dtype}"


class GroupReducer:
    """One rank's collective calls.

    `build` makes the reducer of all ranks for buffers of a length, when it is first needed: by
    all ranks in the same call.
    """

    def __init__(self, messenger: Messenger, build: Callable[[int], SharedMemoryGroup]) -> None:
        self._messenger = messenger
        self._build = build
        self._reducer: SharedMemoryGroup | None = None
        self._num_floats = 0

    def reduce(self, members: Iterable[int], tree: Any, op: Operation) -> Any:
        """The mean or the sum of `tree` over `members`, bit-identical on all of them.

        Collective, see `gmijax.Role.collective`. Arrays and floats are reduced, those of 16 bits
        and less in float32; all else is this rank's own.

        Raises:
          ConfigError: an unknown operation, or a group without this rank.
          CollectiveError: members come with different data or operations (names both), or the
            mean of integers is wanted.
          PeerLost, CollectiveTimeout: a member is gone, or did not come in time; names it.
        """
        group = sorted({int(member) for member in members})
        self._check(group, op)
        skeleton, arrays = flatten(tree, scalars=True)
        reduced: dict[int, npt.NDArray[Any]] = {}
        for dtype in dict.fromkeys(array.dtype for array in arrays):
            indices = [index for index, array in enumerate(arrays) if array.dtype == dtype]
            flat = np.concatenate([arrays[index].reshape(-1) for index in indices])
            result = self._reduce_flat(group, flat, op)
            ends = np.cumsum([arrays[index].size for index in indices])[:-1]
            reduced.update(zip(indices, np.split(result, ends), strict=True))
        return unflatten(skeleton, [as_bytes(reduced[index]) for index in range(len(arrays))])

    def close(self) -> None:
        """Closes the reducer, if one was made."""
        if self._reducer is not None:
            self._reducer.close()

    def _check(self, members: Sequence[int], op: str) -> None:
        rank, world_size = self._messenger.rank, self._messenger.world_size
        if op not in get_args(Operation):
            raise ConfigError(f"op={op!r}: expected one of {', '.join(get_args(Operation))}")
        if rank not in members:
            raise ConfigError(f"group={members}: GMI {rank} takes part, and is not a member")
        if members[0] < 0 or members[-1] >= world_size:
            raise ConfigError(f"group={members}: there are GMIs 0 to {world_size - 1}")

    def _reduce_flat(
        self, group: Sequence[int], flat: npt.NDArray[Any], op: Operation
    ) -> npt.NDArray[Any]:
        """The mean or sum of a flat array [n] over `group`, by the faster way."""
        of_all = len(group) == self._messenger.world_size > 1
        if of_all and op == "mean" and flat.dtype == np.float32 and flat.nbytes > AT_ONCE_BYTES:
            self._num_floats = self._num_floats or flat.size
            if flat.size == self._num_floats:
                return self._mean_of_all(flat)
        return self._by_messages(group, flat, op)

    def _mean_of_all(self, flat: FloatBuffer) -> FloatBuffer:
        call = _Call("mean", flat.size, flat.dtype.name)
        self._require_no_other(call)
        try:
            if self._reducer is None:
                self._reducer = self._build(flat.size)
            return self._reducer.mean(flat)
        except CollectiveTimeout:
            self._require_no_other(call)
            raise

    def _by_messages(
        self, members: Sequence[int], flat: npt.NDArray[Any], op: Operation
    ) -> npt.NDArray[Any]:
        call, wide = _Call(op, flat.size, flat.dtype.name), _summing_dtype(flat.dtype)
        if not np.issubdtype(wide, np.inexact if op == "mean" else np.number):
            what = "real or complex numbers" if op == "mean" else "numbers"
            rank = self._messenger.rank
            raise CollectiveError(f"GMI {rank}: {op} of {flat.dtype}; it takes {what}")
        own = flat.astype(wide, copy=False)
        if own.nbytes <= AT_ONCE_BYTES:
            result = _sum(self._exchange(call, dict.fromkeys(members, own)))
        else:
            parts = dict(zip(members, np.array_split(own, len(members)), strict=True))
            part = _sum(self._exchange(call, parts))
            result = np.concatenate(self._exchange(call, dict.fromkeys(members, part)))
        if op == "mean":
            # As `Collectives.mean` has it.
            result *= np.finfo(wide).dtype.type(1.0 / len(members))
        return result.astype(flat.dtype, copy=False)

    def _exchange(self, call: _Call, parts: dict[int, npt.NDArray[Any]]) -> list[npt.NDArray[Any]]:
        """Sends every member its part of what is reduced; returns theirs, in order of rank."""
        rank = self._messenger.rank
        for member, part in parts.items():
            if member != rank:
                self._messenger.send((*call, part), member, tag=COLLECTIVE)
        return [self._receive(call, m) if m != rank else part for m, part in parts.items()]

    def _receive(self, call: _Call, member: int) -> Any:
        """What `member` has sent; it must ask for the same as this rank."""
        *theirs, part = self._messenger.recv(member, tag=COLLECTIVE)
        # With the size of all: parts of data of different lengths may well be equally long.
        if (other := _Call(*theirs)) != call:
            rank = self._messenger.rank
            raise CollectiveError(f"GMI {rank} asks for {call}, GMI {member} for {other}")
        return part

    def _require_no_other(self, call: _Call) -> None:
        """Raises CollectiveError if a rank has come with a call that goes by messages.

        A mean by the reducer of all sends none, so each would wait where the other does not look.
        It gets what this rank asks for, and all such ranks raise the same.
        """
        rank, world_size = self._messenger.rank, self._messenger.world_size
        others = [other for other in range(world_size) if other != rank]
        came = [other for other in others if self._messenger.has_message(other, tag=COLLECTIVE)]
        for other in came:
            self._messenger.send((*call, None), other, tag=COLLECTIVE)
        for other in came[:1]:
            self._receive(call, other)


def _sum(parts: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    total = parts[0].copy()
    for part in parts[1:]:
        total += part
    return total


def _summing_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    # jax's own formats (bfloat16 and smaller) are of a kind of their own to numpy.
    own_format = dtype.kind == "V" and dtype.names is None
    narrow = own_format or (dtype.kind == "f" and dtype.itemsize < 4)
    return np.dtype(np.float32) if narrow else dtype

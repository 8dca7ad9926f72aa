"""The heartbeat: how a GMI reports its progress and why it fails, in memory of both processes.

Not a file: it is written within training, where a full or a slow disk must not end or delay it.
A block of eight 64-bit numbers (beats, state, iteration, process, bytes of the error), then the
error as JSON. One process writes, the controller reads; the number of beats is written last.
"""

from __future__ import annotations

import json
import mmap
import os
from typing import Any, Final, Literal, NamedTuple, get_args

from gmijax.errors import ReportedError, gist_of

GmiState = Literal["starting", "waiting", "compiling", "ready", "running", "done"]

STATES: tuple[str, ...] = get_args(GmiState)
"""The states of a GMI in the order in which it reaches them; `waiting` for another to compile."""

_BEATS, _STATE, _ITERATION, _PID, _ERROR_BYTES = range(5)
_HEADER_BYTES: Final = 64
_BLOCK_BYTES: Final = 1 << 16
_MAX_MESSAGE, _MAX_TRACEBACK, _MAX_MISSING = 2000, 8000, 200
"""Characters, which as JSON may take six bytes each, and ranks."""


class Heartbeat(NamedTuple):
    """Last report of a GMI.

    Attributes:
      state: how far it is.
      iteration: training iterations done.
      pid: the process that uses the GPU; not the started one where that is a wrapper.
    """

    state: GmiState
    iteration: int
    pid: int

    @property
    def is_ready(self) -> bool:
        """Whether the GMI has compiled its program."""
        return STATES.index(self.state) >= STATES.index("ready")


class HeartbeatBlock:
    """Memory for the beats and the error of one GMI.

    Args:
      fd: of `create`, or inherited; None for memory that no other process reads.
    """

    def __init__(self, fd: int | None = None) -> None:
        self._memory = mmap.mmap(-1 if fd is None else fd, _BLOCK_BYTES)
        self._numbers = memoryview(self._memory)[:_HEADER_BYTES].cast("Q")

    @staticmethod
    def create() -> int:
        """A descriptor of a new block without a name, all zeros; the caller closes it."""
        fd = os.memfd_create("gmijax-heartbeat")
        os.ftruncate(fd, _BLOCK_BYTES)
        return fd

    @property
    def beats(self) -> int:
        """How often `write` was called."""
        return self._numbers[_BEATS]

    def write(self, beat: Heartbeat) -> None:
        """Replaces the beat before."""
        self._numbers[_STATE] = STATES.index(beat.state)
        self._numbers[_ITERATION] = beat.iteration
        self._numbers[_PID] = beat.pid
        self._numbers[_BEATS] += 1

    def read(self) -> Heartbeat | None:
        """The last beat, None before the first."""
        if not self.beats:
            return None
        state: Any = STATES[self._numbers[_STATE]]
        return Heartbeat(state, self._numbers[_ITERATION], self._numbers[_PID])

    def write_error(self, error: ReportedError) -> None:
        """Reports why the GMI fails; of a long message the gist, of a long traceback the end."""
        is_long = len(error.message) > _MAX_MESSAGE
        message = gist_of(error.message) if is_long else error.message
        cut = error._replace(
            message=message[:_MAX_MESSAGE],
            traceback=error.traceback[-_MAX_TRACEBACK:],
            missing=error.missing[:_MAX_MISSING],
        )
        text = json.dumps(cut._asdict(), ensure_ascii=False).encode(errors="replace")
        self._memory[_HEADER_BYTES : _HEADER_BYTES + len(text)] = text
        self._numbers[_ERROR_BYTES] = len(text)

    def read_error(self) -> ReportedError | None:
        """Why the GMI failed, None if it has reported no error."""
        size = self._numbers[_ERROR_BYTES]
        if not size:
            return None
        data: dict[str, Any] = json.loads(self._memory[_HEADER_BYTES : _HEADER_BYTES + size])
        return ReportedError(**data)._replace(missing=tuple(data["missing"]))

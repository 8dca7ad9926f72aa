"""The two ends of the messages between two ranks: what is on its way out, what came in.

Format of a message, native byte order: uint64 tag, uint64 number of parts, uint64 length of every
part; then the parts, of which the first is a skeleton (`trees.py`) and the others the bytes of its
arrays. It travels as one or more messages of the pipe, *frames*, which are cut
without regard to the parts.
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeAlias

import numpy as np

from gmijax.channels.pipe import Bytes, PipeWriter
from gmijax.channels.trees import as_bytes, flatten, unflatten
from gmijax.clock import wait_for
from gmijax.errors import CollectiveError, CollectiveTimeout

DATA, COLLECTIVE = 0, 1
"""Tags: messages of a role, and those of its collective calls. They never mix."""

MAX_WAITING_BYTES: Final = 1 << 30
"""Most that waits to be passed on to one rank; beyond it sending waits too."""

MAX_PARTS: Final = 256
"""Most parts of a frame: each costs up to 72 bytes of the pipe."""

Frame: TypeAlias = list[Bytes]

_HEAD = struct.Struct("=QQ")


def frames_of(
    tree: Any, tag: int, frame_bytes: int, put: Callable[[Any], Any] = lambda _: None
) -> list[Frame]:
    """The message that carries `tree`, as frames of at most `frame_bytes`; views of its arrays.

    For `put` see `flatten`.
    """
    skeleton, arrays = flatten(tree, put=put)
    parts = [np.frombuffer(skeleton, np.uint8), *map(as_bytes, arrays)]
    head = np.array([tag, len(parts), *(part.size for part in parts)], np.uint64)
    frames: list[Frame] = [[]]
    free_bytes = frame_bytes
    for part in (head.view(np.uint8), *parts):
        start = 0
        while start < part.size:
            if not free_bytes or len(frames[-1]) == MAX_PARTS:
                frames.append([])
                free_bytes = frame_bytes
            piece = part[start : start + free_bytes]
            frames[-1].append(piece)
            start += piece.size
            free_bytes -= piece.size
    return frames


class Outbox:
    """What is on its way to one rank; `frames` counts those that ever were."""

    def __init__(self, writer: PipeWriter, rank: int) -> None:
        self.frames = 0
        self._writer = writer
        self._rank = rank
        self._frames: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._waiting_bytes = 0
        self._posts = 0
        self._error: CollectiveError | None = None
        self._thread: threading.Thread | None = None

    @property
    def released_frames(self) -> int:
        """How many frames the receiver has released."""
        return self._writer.released_messages

    def post(self, frames: Sequence[Frame], timeout_s: float) -> None:
        """Puts the frames into the pipe, or copies of them behind those that wait.

        All of them or none: it only waits where others do, and then has put nothing yet.
        """
        left = deque(frames)
        self._posts += 1
        with self._changed:
            self._raise_error()
            # A frame that the thread is busy with is still among those that wait.
            while left and not self._frames and self._writer.try_put(left[0]):
                left.popleft()
            if left and not self._wait_for(self._has_space, timeout_s):
                peers = (self._writer.peer,)
                raise CollectiveTimeout(self._rank, peers, "send", self._posts, timeout_s)
            self._raise_error()
            self.frames += len(frames)
            for frame in left:
                copied = np.concatenate(frame)
                self._frames.append([copied])
                self._waiting_bytes += copied.size
            if left:
                self._start_thread()
                self._changed.notify_all()

    def wait_until_empty(self, timeout_s: float) -> bool:
        """Whether all frames got into the pipe; raises what the thread met."""
        with self._changed:
            self._wait_for(lambda: not self._frames or self._error is not None, timeout_s)
            self._raise_error()
            return not self._frames

    def _wait_for(self, is_so: Callable[[], bool], timeout_s: float) -> bool:
        """Waits for a change that makes it so; whether it came in time."""
        return wait_for(lambda seconds: self._changed.wait_for(is_so, seconds), timeout_s)

    def _has_space(self) -> bool:
        return self._waiting_bytes < MAX_WAITING_BYTES or self._error is not None

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _start_thread(self) -> None:
        if self._thread is None:
            # A daemon: it must not keep a GMI alive that has failed.
            self._thread = threading.Thread(
                target=self._pass_on, name=f"send-{self._writer.peer}", daemon=True
            )
            self._thread.start()

    def _pass_on(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._frames)
                frame = self._frames[0]
            try:
                # The receiver comes when it likes; only its end is an error.
                self._writer.put(frame, float("inf"))
            except CollectiveError as error:
                with self._changed:
                    self._error = error
                    self._changed.notify_all()
                return
            with self._changed:
                self._frames.popleft()
                self._waiting_bytes -= frame[0].size
                self._changed.notify_all()


class Inbox:
    """Puts the frames of one rank together to messages; any of them may end anywhere.

    Complete ones are in `ready`, by tag and in order of arrival; `received` counts them. For
    `get` see `unflatten`.
    """

    def __init__(self, get: Callable[[Any], Any] | None = None) -> None:
        self._get = get
        self.ready: dict[int, deque[Any]] = {DATA: deque(), COLLECTIVE: deque()}
        self.received = 0
        self._begin()

    def feed(self, frame: Sequence[Bytes]) -> None:
        """Takes the parts of the next frame; copies them."""
        for part in frame:
            data = part
            while data.size:
                count = min(self._unfilled.size, data.size)
                self._unfilled[:count] = data[:count]
                self._unfilled, data = self._unfilled[count:], data[count:]
                self._advance()

    def _begin(self) -> None:
        self._buffers = self._fill_messages()
        self._unfilled = next(self._buffers)

    def _advance(self) -> None:
        """Moves to the next buffer that is not full."""
        try:
            while not self._unfilled.size:
                self._unfilled = next(self._buffers)
        except BaseException:  # Of a message that cannot be unpickled: the next one may be.
            self._begin()
            raise

    def _fill_messages(self) -> Iterator[Bytes]:
        """Yields the next buffer to fill; it counts as filled when the next one is requested."""
        while True:
            yield (head := np.empty(_HEAD.size, np.uint8))
            tag, num_parts = _HEAD.unpack(head.data)
            yield (sizes := np.empty(8 * num_parts, np.uint8))
            parts = [np.empty(size, np.uint8) for size in sizes.view(np.uint64).tolist()]
            yield from parts
            self.received += 1
            self.ready[tag].append(unflatten(parts[0].data, parts[1:], self._get))

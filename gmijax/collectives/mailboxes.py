"""The two ends of the messages between two ranks: what is on its way out, what came in.

Format of a message, native byte order: uint64 tag, uint64 number of parts, uint64 length of every
part; then the parts, of which the first is a skeleton (`gmijax.collectives.trees`) and the others
the bytes of its arrays. It travels as one or more messages of the pipe, *frames*, which are cut
without regard to the parts.
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeAlias

import numpy as np

from gmijax.collectives.pipe import Bytes, PipeWriter
from gmijax.collectives.trees import as_bytes, flatten, unflatten
from gmijax.errors import CollectiveError, CollectiveTimeout

DATA, COLLECTIVE = 0, 1
"""Tags: messages of a role, and those of its collective calls. They never mix."""

MAX_WAITING_BYTES: Final = 1 << 30
"""Most that waits to be passed on to one rank; beyond it sending waits too."""

MAX_PARTS: Final = 256
"""Most parts of a frame: each costs up to 72 bytes of the pipe."""

Frame: TypeAlias = list[Bytes]

_WORD = struct.Struct("=Q")
_HEAD = struct.Struct("=QQ")


def frames_of(
    tree: Any, tag: int, frame_bytes: int, stow: Callable[[Any], Any] = lambda _: None
) -> list[Frame]:
    """The message that carries `tree`, as frames of at most `frame_bytes`; views of its arrays.

    Args:
      tree: nested data.
      tag: `DATA` or `COLLECTIVE`.
      frame_bytes: see above.
      stow: what stays where it is, see `gmijax.collectives.trees.flatten`.
    """
    skeleton, arrays = flatten(tree, stow=stow)
    parts = [np.frombuffer(skeleton, np.uint8), *map(as_bytes, arrays)]
    lengths = [part.size for part in parts]
    head = struct.pack(f"=QQ{len(parts)}Q", tag, len(parts), *lengths)
    return _cut([np.frombuffer(head, np.uint8), *parts], frame_bytes)


class Outbox:
    """What is on its way to one rank.

    Attributes:
      frames: that are in the pipe, or wait for it.
    """

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
            if not left:
                self.frames += len(frames)
                return
            if not self._changed.wait_for(self._has_room, timeout_s):
                raise CollectiveTimeout(
                    self._rank, (self._writer.dst,), "send", self._posts, timeout_s
                )
            self._raise_error()
            self.frames += len(frames)
            for frame in left:
                copied = np.concatenate(frame)
                self._frames.append([copied])
                self._waiting_bytes += copied.size
            self._start_thread()
            self._changed.notify_all()

    def wait_until_empty(self, timeout_s: float) -> bool:
        """Whether all frames got into the pipe; raises what the thread met."""
        with self._changed:
            self._changed.wait_for(lambda: not self._frames or self._error, max(0.0, timeout_s))
            self._raise_error()
            return not self._frames

    def _has_room(self) -> bool:
        return self._waiting_bytes < MAX_WAITING_BYTES or self._error is not None

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _start_thread(self) -> None:
        if self._thread is None:
            # A daemon: it must not keep a GMI alive that has failed.
            self._thread = threading.Thread(
                target=self._pass_on, name=f"send-{self._writer.dst}", daemon=True
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

    Attributes:
      ready: complete messages by tag, in order of arrival.
      received: how many there were.

    Args:
      fetch: for what stayed where it was, see `gmijax.collectives.trees.unflatten`.
    """

    def __init__(self, fetch: Callable[[Any], Any] | None = None) -> None:
        self._fetch = fetch
        self.ready: dict[int, deque[Any]] = {DATA: deque(), COLLECTIVE: deque()}
        self.received = 0
        self._start()

    def feed(self, frame: Sequence[Bytes]) -> None:
        """Takes the parts of the next frame; copies them."""
        for part in frame:
            self._take(part)

    def _take(self, data: Bytes) -> None:
        while data.size:
            target = self._targets[0][self._filled :]
            count = min(target.size, data.size)
            target[:count] = data[:count]
            data = data[count:]
            self._filled += count
            while self._targets and self._filled == self._targets[0].size:
                self._full.append(self._targets.popleft())
                self._filled = 0
                self._advance()

    def _start(self) -> None:
        self._targets = deque([np.empty(_HEAD.size, np.uint8)])
        self._full: list[Bytes] = []
        self._filled = 0

    def _advance(self) -> None:
        """Makes room for what the last full part announces, or completes the message."""
        if self._targets:
            return
        if len(self._full) == 1:
            _, num_parts = _HEAD.unpack(self._full[0].data)
            self._targets.append(np.empty(num_parts * _WORD.size, np.uint8))
        elif len(self._full) == 2:
            lengths = self._full[1].view(np.uint64).tolist()
            self._targets.extend(np.empty(length, np.uint8) for length in lengths)
        else:
            tag, _ = _HEAD.unpack(self._full[0].data)
            skeleton, *buffers = self._full[2:]
            self._start()
            self.received += 1
            self.ready[tag].append(unflatten(skeleton.data, buffers, self._fetch))


def _cut(parts: Sequence[Bytes], frame_bytes: int) -> list[Frame]:
    """The bytes of `parts` as frames of at most `frame_bytes`, each a list of views."""
    frames: list[Frame] = [[]]
    room = frame_bytes
    for part in parts:
        start = 0
        while start < part.size:
            if not room or len(frames[-1]) == MAX_PARTS:
                frames.append([])
                room = frame_bytes
            piece = part[start : start + room]
            frames[-1].append(piece)
            start += piece.size
            room -= piece.size
    return frames

"""Follows the TensorBoard files that a job writes below its folder, for one tag."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from gmijax.clock import running_s
from gmijax.packs.trainers import Report

_FILES: Final = "events.out.tfevents.*"
_LOOK_S: Final = 10.0
"""Between two searches of the folder for files."""

_LENGTH: Final = struct.Struct("<Q")
_CHECK: Final = 4  # Bytes of a checksum: one after the length, one after the data.
_MOST_BYTES: Final = 1 << 24
"""Of one record. A longer one is no event, so the file is not read on."""


class EventReader:
    """Values of a tag in all event files of a folder, in the order in which they come.

    Files are those of TFRecord: length, checksum, data, checksum; data is an `Event`.

    Args:
      folder: of the job; files may lie in any folder below it.
      tag: of the scalar, e.g. `Train/mean_reward`.
      since_s: files that were not changed since then, in seconds since the epoch, are those of an
        earlier attempt.
      clock: seconds.
    """

    def __init__(
        self, folder: Path, tag: str, since_s: float, clock: Callable[[], float] = running_s
    ) -> None:
        self._folder, self._tag, self._since_s, self._clock = folder, tag, since_s, clock
        self._searched_s: float | None = None
        self._offsets: dict[Path, int] = {}

    def new(self) -> list[Report]:
        """Steps and values that came since the last call."""
        now_s = self._clock()
        if self._searched_s is None or now_s - self._searched_s >= _LOOK_S:
            self._searched_s = now_s
            with suppress(OSError):  # The job may remove what is listed.
                for path in sorted(self._folder.rglob(_FILES)):
                    if path not in self._offsets and path.stat().st_mtime >= self._since_s:
                        self._offsets[path] = 0
        return [report for path in self._offsets for report in self._of_file(path)]

    def _of_file(self, path: Path) -> Iterator[Report]:
        from google.protobuf.message import DecodeError  # Takes a moment; most packs need none.

        from gmijax.runs.tensorboard import Event

        try:
            with path.open("rb") as file:
                file.seek(self._offsets[path])
                found = file.read(_MOST_BYTES)
        except OSError:
            return
        at = 0
        while (data := _record(found, at)) is not None:
            at += _LENGTH.size + len(data) + 2 * _CHECK
            with suppress(DecodeError):
                yield from self._values(Event.FromString(data))
        self._offsets[path] += at

    def _values(self, event: Any) -> Iterator[Report]:
        for value in event.summary.value:
            if value.tag != self._tag:
                continue
            # TensorFlow 2 writes scalars as tensors.
            number = value.simple_value
            if value.HasField("tensor") and value.tensor.float_val:
                number = value.tensor.float_val[0]
            yield Report(steps=float(event.step), metric=float(number))


def _record(found: bytes, at: int) -> bytes | None:
    """The data of the record that begins at a byte; None: it is not complete."""
    begins = at + _LENGTH.size + _CHECK
    if begins > len(found):
        return None
    (length,) = _LENGTH.unpack_from(found, at)
    ends = begins + length
    return found[begins:ends] if ends + _CHECK <= len(found) else None

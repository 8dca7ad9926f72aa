"""Follows the TensorBoard files that a job writes below its folder, for one tag."""

from __future__ import annotations

import os
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
"""Of one look, which must stay short. A longer record, such as a film, has no scalar."""
_LONGEST_BYTES: Final = 1 << 31
"""Of one record, as of any protobuf message. A file with a longer one is damaged."""
_DAMAGED: Final = 1 << 63
"""An offset for "do not read on": beyond the end of any file."""


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

        for data in self._new_records(path):
            with suppress(DecodeError):
                yield from self._values(Event.FromString(data))

    def _new_records(self, path: Path) -> list[bytes]:
        """Data of records that are complete; long ones are passed over without being read."""
        records: list[bytes] = []
        num_bytes, offset = 0, self._offsets[path]
        with suppress(OSError, struct.error), path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            while num_bytes < _MOST_BYTES and offset + _LENGTH.size <= size:
                file.seek(offset)
                (length,) = _LENGTH.unpack(file.read(_LENGTH.size))
                if length > _LONGEST_BYTES:
                    offset = _DAMAGED
                    break
                ends = offset + _LENGTH.size + length + 2 * _CHECK
                if ends > size:
                    break
                if length <= _MOST_BYTES:
                    file.seek(_CHECK, os.SEEK_CUR)
                    records.append(file.read(length))
                    num_bytes += ends - offset
                offset = ends
        self._offsets[path] = offset
        return records

    def _values(self, event: Any) -> Iterator[Report]:
        for value in event.summary.value:
            if value.tag != self._tag:
                continue
            # TensorFlow 2 writes scalars as tensors.
            number = value.simple_value
            if value.HasField("tensor") and value.tensor.float_val:
                number = value.tensor.float_val[0]
            yield Report(steps=float(event.step), metric=float(number))

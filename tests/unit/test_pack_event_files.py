"""TensorBoard files of a job: read while they are written."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2

from gmijax.packs import event_files
from gmijax.packs.event_files import EventReader
from gmijax.packs.output import OutputReader
from gmijax.packs.progress import ProgressReader, own_patterns
from gmijax.packs.trainers import Report

TAG = "Train/mean_reward"
EVENT: Any = vars(event_pb2)["Event"]


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[EventsWriter]:
    (tmp_path / "logs" / "a").mkdir(parents=True)
    writer = EventsWriter(str(tmp_path / "logs" / "a" / "events"))
    yield writer
    writer.close()


def add(writer: EventsWriter, step: int, value: float, tag: str = TAG) -> None:
    event = EVENT(step=step)
    event.summary.value.add(tag=tag, simple_value=value)
    writer.write_event(event)
    writer.flush()


def test_values_of_the_tag_come_once_in_their_order(tmp_path: Path, writer: EventsWriter) -> None:
    reader = EventReader(tmp_path, TAG, since_s=0.0)
    add(writer, 1, 0.5)
    add(writer, 1, 9.0, tag="Loss")
    add(writer, 2, 1.5)
    assert reader.new() == [Report(steps=1.0, metric=0.5), Report(steps=2.0, metric=1.5)]
    assert reader.new() == []
    add(writer, 3, 2.5)
    assert reader.new() == [Report(steps=3.0, metric=2.5)]


def test_a_record_that_is_half_written_is_read_later(tmp_path: Path) -> None:
    event = EVENT(step=7)
    event.summary.value.add(tag=TAG, simple_value=2.0)
    data = event.SerializeToString()
    whole = struct.pack("<Q", len(data)) + bytes(4) + data + bytes(4)
    file = tmp_path / "events.out.tfevents.1"
    for cut in range(len(whole)):
        file.write_bytes(whole[:cut])
        reader = EventReader(tmp_path, TAG, since_s=0.0)
        assert reader.new() == []
        file.write_bytes(whole)
        assert reader.new() == [Report(steps=7.0, metric=2.0)]


def test_scalars_that_are_tensors_are_read(tmp_path: Path) -> None:
    event = EVENT(step=1)
    event.summary.value.add(tag=TAG).tensor.float_val.append(4.0)
    data = event.SerializeToString()
    whole = struct.pack("<Q", len(data)) + bytes(4) + data + bytes(4)
    (tmp_path / "events.out.tfevents.1").write_bytes(whole)
    assert EventReader(tmp_path, TAG, since_s=0.0).new() == [Report(steps=1.0, metric=4.0)]


def record_of(step: int, value: float) -> bytes:
    event = EVENT(step=step)
    event.summary.value.add(tag=TAG, simple_value=value)
    data = event.SerializeToString()
    return struct.pack("<Q", len(data)) + bytes(4) + data + bytes(4)


def test_a_long_record_is_passed_over_once_it_is_complete(tmp_path: Path) -> None:
    """A logged film, for one."""
    file, length = tmp_path / "events.out.tfevents.1", 20 << 20
    file.write_bytes(record_of(1, 0.5) + struct.pack("<Q", length))
    begins = file.stat().st_size
    os.truncate(file, begins + length // 2)
    reader = EventReader(tmp_path, TAG, since_s=0.0)
    assert reader.new() == [Report(steps=1.0, metric=0.5)]
    assert reader.new() == []
    os.truncate(file, begins + 4 + length + 4)
    with file.open("ab") as more:
        more.write(record_of(2, 1.5))
    assert reader.new() == [Report(steps=2.0, metric=1.5)]
    assert reader.new() == []


def test_many_records_are_read_in_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a look stays short."""
    monkeypatch.setattr(event_files, "_MOST_BYTES", 100)
    file = tmp_path / "events.out.tfevents.1"
    file.write_bytes(b"".join(record_of(step, 0.5) for step in range(1, 11)))
    reader, found = EventReader(tmp_path, TAG, since_s=0.0), list[Report]()
    turns = 0
    while new := reader.new():
        found += new
        turns += 1
    assert [report.steps for report in found] == list(range(1, 11))
    assert turns > 1


def test_a_damaged_file_is_not_read_on(tmp_path: Path) -> None:
    clock, file = Clock(), tmp_path / "events.out.tfevents.1"
    file.write_bytes(record_of(1, 0.5) + b"\xff" * 100)
    reader = EventReader(tmp_path, TAG, 0.0, clock)
    assert reader.new() == [Report(steps=1.0, metric=0.5)]
    file.write_bytes(record_of(1, 0.5) + record_of(2, 1.5))
    clock.now_s += 60.0
    assert reader.new() == []


def test_files_of_an_earlier_attempt_are_left_alone(tmp_path: Path, writer: EventsWriter) -> None:
    add(writer, 1, 0.5)
    (file,) = tmp_path.rglob("events.out*")
    assert EventReader(tmp_path, TAG, since_s=file.stat().st_mtime + 1.0).new() == []


def test_a_file_that_goes_while_the_folder_is_searched_is_nothing(tmp_path: Path) -> None:
    (tmp_path / "events.out.tfevents.1").symlink_to(tmp_path / "gone")
    assert EventReader(tmp_path, TAG, since_s=0.0).new() == []


def test_what_is_no_event_file_is_nothing(tmp_path: Path) -> None:
    (tmp_path / "events.out.tfevents.1").write_bytes(b"\xff" * 100)
    (tmp_path / "events.out.tfevents.2").write_bytes(struct.pack("<Q", 4) + b"nothing here")
    assert EventReader(tmp_path, TAG, since_s=0.0).new() == []


def test_a_program_that_prints_nothing_has_a_rate(tmp_path: Path, writer: EventsWriter) -> None:
    clock = Clock()
    events = EventReader(tmp_path, TAG, 0.0, clock)
    reader = ProgressReader(OutputReader(tmp_path / "log"), None, 0.0, events, clock)
    for step in (100, 200, 300):
        clock.now_s += 10.0
        add(writer, step, step / 100)
        (line,) = reader.new()
    assert line == {"env_steps": 300, "env_steps_per_s": 10.0, "metric": 3.0}


def test_steps_that_are_printed_win_over_those_of_the_files(
    tmp_path: Path, writer: EventsWriter
) -> None:
    clock, log = Clock(), tmp_path / "log"
    events = EventReader(tmp_path, TAG, 0.0, clock)
    own = own_patterns(None, r"at (\d+)", None)
    reader = ProgressReader(OutputReader(log), own, 0.0, events, clock)
    clock.now_s += 10.0
    log.write_text("at 5000, reward=7\n")
    add(writer, 1, 2.0)
    assert [line["env_steps"] for line in reader.new()] == [5000]
    clock.now_s += 10.0
    log.write_text("at 5000, reward=7\nat 6000, reward=7\n")
    (line,) = reader.new()
    assert line == {"env_steps": 6000, "env_steps_per_s": 100.0, "metric": 2.0}

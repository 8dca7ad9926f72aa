"""MPR between real processes: how ranks find each other, the wire format, mistakes."""

from __future__ import annotations

import mmap
import os
import signal
import struct
from pathlib import Path

import numpy as np

from gmijax.collectives.host.shared_block import Geometry, attach, process_of
from tests.rank_processes import Ranks


def test_a_late_rank_is_waited_for_beyond_the_timeout_of_later_calls(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once", timeout_s=0.2) as job:
        job.start(0)
        job.wait_for("attached")
        job.start(1, pause_s=0.6)
        assert [result.get("mean") for result in job.results()] == [1.5, 1.5]


def test_a_rank_that_never_comes_is_missing_not_lost(tmp_path: Path) -> None:
    with Ranks(tmp_path, 3, "call_once", start_s=0.6).start(0, 2) as job:
        results = job.results(0, 2)
    assert [result["error"] for result in results] == ["CollectiveTimeout"] * 2
    assert all(1 in result["missing"] for result in results)


def test_a_rank_killed_before_its_first_call_is_lost(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once").start(1, pause_s=20.0) as job:
        job.wait_for("attached")
        job.signal(1, signal.SIGKILL)
        job.start(0)
        (result,) = job.results(0)
    assert (result["error"], result["peer"]) == ("PeerLost", 1)


def test_a_rank_that_has_closed_is_lost_to_those_who_still_call(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once").start(0) as job:
        job.start(1, body="close_at_once", stay_s=20.0)
        (result,) = job.results(0)
    assert (result["error"], result["peer"]) == ("PeerLost", 1)


def test_ranks_with_different_lengths_name_both(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once").start(0, num_floats=5000) as job:
        job.start(1, num_floats=200_000)
        messages = [result["message"] for result in job.results()]
    assert messages == [
        "rank 0 and rank 1 do not fit together: num_floats is 5000 for rank 0, "
        "and 200000 for rank 1",
        "rank 1 and rank 0 do not fit together: num_floats is 200000 for rank 1, "
        "and 5000 for rank 0",
    ]


def test_ranks_that_come_to_different_exchanges_name_both(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "step_in_different_orders", num_floats=64).start() as job:
        messages = [result["message"] for result in job.results()]
    mean, gather = "sum of 64 floats", "sum of 128 floats"
    assert messages[0].startswith(f"step 1: rank 0 calls {mean}")
    assert f"rank 1 calls {gather}" in messages[0]
    assert messages[1].startswith(f"step 1: rank 1 calls {gather}")
    assert f"rank 0 calls {mean}" in messages[1]


def test_one_rank_number_is_given_once(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once").start(1, pause_s=20.0) as job:
        job.wait_for("attached")
        holder = job.processes[1]
        (tmp_path / "attached_1").unlink()
        job.start(1)
        (result,) = job.results(1)
        holder.kill()
        holder.wait()
    assert result["message"] == f"rank 1 is taken already by process {holder.pid}"


def test_a_buffer_written_by_another_process_is_read_by_the_documented_format(
    tmp_path: Path,
) -> None:
    with Ranks(tmp_path, 2, "call_once", num_floats=3000, stay_s=20.0).start() as job:
        job.wait_for("called")
        raw = mmap.mmap(job.fd, os.fstat(job.fd).st_size, prot=mmap.PROT_READ)
        line = 3 * 64  # The second rank's in the lane of programs.
        head = struct.unpack_from("=4sHHHHIQQ", raw, line)
        (sequence,) = struct.unpack_from("=Q", raw, line + 56)
        at = Geometry.of(2, 3000)
        own, first = (
            np.frombuffer(raw, np.float32, 3000, at.slots + row * at.row_floats * 4).tolist()
            for row in (3, 2)  # Of the second slots, since this is the first call.
        )
    magic, version, world_size, rank, blamed, _, num_floats, pid = head
    assert (magic, version, world_size, rank, blamed) == (b"GMIX", 4, 2, 1, 0)
    assert (num_floats, pid) == (3000, job.processes[1].pid)
    assert sequence == 3  # attached, then the two meetings of one sum
    assert own == [2.0] * 3000
    assert first == [3.0] * 3000


def test_a_rank_sees_whether_the_process_of_another_one_lives(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_once", pause_s=20.0).start(1) as job:
        job.wait_for("attached")
        peer = process_of(attach(job.fd, 0, 2, 100), 1)
        assert peer.pid == job.processes[1].pid
        assert peer.is_running()
        job.signal(1, signal.SIGKILL)
        os.waitid(os.P_PID, peer.pid, os.WEXITED | os.WNOWAIT)
        assert not peer.is_running()  # a zombie still


def test_the_block_has_no_name_so_that_no_kill_leaves_it_behind(tmp_path: Path) -> None:
    with Ranks(tmp_path, 2, "call_forever").start() as job:
        job.wait_for("running")
        assert job.named_memory() == set()
        maps = Path(f"/proc/{job.processes[0].pid}/maps").read_text()
    assert "/memfd:gmijax-exchange (deleted)" in maps

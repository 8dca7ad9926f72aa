"""Roles for the tests of `gmijax.launch`; none of them needs jax, so that they start quickly."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from training_jobs import wait_until

import gmijax
from gmijax.errors import CollectiveError, CollectiveTimeout, ConfigError, PeerLost


class Pair(NamedTuple):
    """One kind of nesting."""

    left: np.ndarray
    right: list


@dataclass
class Box:
    """Another kind of nesting."""

    content: np.ndarray
    note: str


def nested(seed: int) -> dict:
    """Many kinds of data, different for every seed."""
    rng = np.random.default_rng(seed)
    return {
        "pair": Pair(rng.random((3, 4), np.float32), [rng.random(2), {"deep": (seed, None)}]),
        "box": Box(np.asfortranarray(rng.random((5, 7))), f"box {seed}"),
        "few": [np.zeros((0, 3), np.int8), np.array(seed, np.uint16), np.array([True, False])],
    }


def same(one: Any, other: Any) -> bool:
    """Whether two nestings hold the same."""
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray)
        return one.dtype == other.dtype and one.shape == other.shape and bool((one == other).all())
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return type(one) is type(other) and all(map(same, one, other))
    if isinstance(one, Box):
        return same([one.content, one.note], [other.content, other.note])
    return one == other


class Talk(gmijax.Role):
    """Sends and reduces all kinds of things; returns what it saw."""

    def __init__(self, large: int) -> None:
        self.large = large

    def run(self, rounds: int) -> dict:
        rank, size = self.rank, self.world_size
        right, left = (rank + 1) % size, (rank - 1) % size
        for step in range(rounds):
            self.send(nested(rank + 10 * step), right)
            self.send(step, rank)
            assert same(self.recv(left), nested(left + 10 * step))
            assert self.recv(rank) == step
        # Larger than the pipe, everybody first sends; changed at once, to show that it is copied.
        large = np.full(self.large, rank, np.int64)
        for peer in (left, right):
            self.send({"large": large, "peer": peer}, peer)
        large[:] = -1
        self.send("last", right)
        # A collective call does not take messages that wait, nor the other way round.
        mean = self.collective({"loss": float(rank), "grads": Pair(large + rank + 0.25, [])})
        for peer in (left, right):
            got = self.recv(peer)
            assert got["peer"] == rank
            assert (got["large"] == peer).all()
            got["large"][0] = 7  # It is the receiver's own.
        assert self.recv(left) == "last"
        group = (0, 2)
        total = self.collective(np.arange(5) * rank, "sum", group) if rank in group else None
        # The mean of many float32 over all goes through a shared block, other lengths do not.
        for length in (10_000, 10_000, 9_999):
            grads = self.collective([np.arange(length, dtype=np.float32) * rank])
            assert (grads[0] == np.arange(length, dtype=np.float32)).all()
        near = self.collective(np.float16([rank]), "sum", self.neighbours)
        return {"mean": mean, "total": total, "near": near, "where": (rank, self.gpu)}


class Wait(gmijax.Role):
    """GMI 0 waits for a message of GMI 1 that never comes, GMI 2 later for both."""

    def run(self, folder: str, ends: str) -> str:
        here, seen = Path(folder) / "here", Path(folder) / "seen"
        if self.rank == 1:
            here.touch()
            self.recv(0, timeout_s=60)
            if ends == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if ends == "raise":
                raise ZeroDivisionError("the sum is off")
            if ends == "sleep":
                time.sleep(60)
            return "done"
        awaited = here if self.rank == 0 else seen
        wait_until(awaited.exists, 60, f"{awaited.name} is there")
        if self.rank == 2:
            self.collective(np.ones(100_000))
        self.send("go", 1)
        began_s = time.monotonic()
        try:
            self.recv(1)
        except (PeerLost, CollectiveTimeout) as error:
            seen.write_text(f"{type(error).__name__} {time.monotonic() - began_s:.1f}")
            # Long enough for the test to see who is blamed although all others fail later.
            time.sleep(1.0)
            raise
        return "not reached"


class Disagree(gmijax.Role):
    """GMIs time out, then come with different data."""

    def run(self) -> str:
        self._time_out()
        for data, op in ((np.ones(3, int), "mean"), (np.ones(3, bool), "sum")):
            with pytest.raises(CollectiveError, match=f"{op} of {data.dtype}; it takes"):
                self.collective(data, op)
        for group in ((1 - self.rank,), (self.rank, 2)):
            with pytest.raises(ConfigError, match=r"^group="):
                self.collective(1.0, group=group)
        with pytest.raises(CollectiveError) as caught:
            self.collective(np.ones(2 + self.rank, np.float32))
        # What GMI 1 sends for the first part is as long as all that GMI 0 has.
        with pytest.raises(CollectiveError, match=r"the sum of .* numbers of float32, GMI"):
            self.collective(np.ones(4096 * (1 + self.rank), np.float32), "sum")
        return str(caught.value)

    def _time_out(self) -> None:
        """A timeout loses nothing: the same message can be waited for again."""
        if self.rank == 0:
            self.recv(1)
            self.send("late", 1)
            return
        with pytest.raises(CollectiveTimeout, match=r"waited 0.05 s in recv, .* GMIs \[0\]"):
            self.recv(0, timeout_s=0.05)
        self.send("go", 0)
        assert self.recv(0) == "late"


class UntilStopped(gmijax.Role):
    """Runs until the user stops the job, and agrees with the others on when."""

    def run(self) -> None:
        for step in range(100_000):
            self.progress(step)
            if self.collective(float(self.stop_requested), "sum") > 0:
                return


class Exit(gmijax.Role):
    """Ends its process as if all were well."""

    def run(self) -> None:
        sys.exit()


class Stuck(gmijax.Role):
    """Makes no progress."""

    def run(self) -> None:
        time.sleep(60)


class Listing(gmijax.Role):
    """The role of the paper's Listing 1, in its own words."""

    def __init__(self, gmi_id: int, role: str, gpu_id: int, manager: gmijax.GMIManager) -> None:
        self.gmi_id = gmi_id
        self.role = role
        self.mgr = manager.add_gmi(gmi_id)
        self.mgr.set_gpu(gmi_id, gpu_id)
        self.group = self.mgr.get_group(gmi_id, role)

    def run(self, scale: int) -> tuple:
        if self.role == "trainer":
            data = self.recv(self.gmi_id - 1)
            return self.role, self.gpu, float(self.collective(data * scale))
        self.send(np.float32(self.gmi_id), self.gmi_id + 1)
        return self.role, self.gpu, float(self.collective(np.float32(self.gmi_id)))

    def collective(self, data, *_):
        return self.mgr.allreduce(data, self.group)

    def send(self, data, dst_gmi_id):
        self.mgr.send(data, dst_gmi_id)

    def recv(self, src_gmi_id, *_):
        return self.mgr.recv(src_gmi_id)

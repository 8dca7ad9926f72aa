"""Steps of the start that succeed on all ranks of a job, or fail on all of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from gmijax.collectives.host.shared_memory_group import SharedMemoryGroup
from gmijax.collectives.nodes.multi_node_group import MultiNodeGroup
from gmijax.errors import DeviceMemoryUnavailable

Group: TypeAlias = SharedMemoryGroup | MultiNodeGroup
"""The ranks of a job, on one node or several."""

NOTE_BYTES = 240
"""Bytes that a rank sends to the others at each step: its result, or the reason of its failure."""


def all_or_none(group: Group, what: str, step: Callable[[], bytes]) -> npt.NDArray[np.uint8]:
    """Does a step of the start; returns what it returned on all ranks.

    Collective: all ranks of the job call it; it returns on all of them or on none.

    Args:
      group: this rank's use of the shared block.
      what: what is unavailable if the step fails, for the message.
      step: returns at most NOTE_BYTES.

    Returns:
      [K, NOTE_BYTES], by rank in the job.

    Raises:
      DeviceMemoryUnavailable: it failed on one of them, and why it did there.
    """
    local = group.local
    try:
        note, has_failed = step(), False
    # Whatever it is, of CUDA, of jax or of an import: there is another way, through the host.
    except Exception as error:
        note, has_failed = warn_of(what, error).encode()[:NOTE_BYTES], True
    sent = np.zeros(1 + NOTE_BYTES, np.float32)  # One number a byte: no float has odd bits.
    sent[0] = 1 + local.ids[local.rank] if has_failed else 0
    sent[1 : 1 + len(note)] = np.frombuffer(note, np.uint8)
    rows = group.bootstrap_all_gather(sent)
    notes = rows[:, 1:].astype(np.uint8)
    if failed := np.flatnonzero(rows[:, 0]).tolist():
        why = notes[failed[0]].tobytes().rstrip(b"\0").decode(errors="replace")
        gmi = int(rows[failed[0], 0]) - 1
        raise DeviceMemoryUnavailable(f"{what}: GMI {gmi}: {why}")
    return notes


def warn_of(what: str, error: Exception) -> str:
    """Warns of what failed on this rank, at once; the error in words.

    The error may never reach the others: they may wait in NCCL, which has no time limit.
    """
    message = " ".join(str(error).split()) or type(error).__name__
    # Of this line, so that Python shows it once, although it is an answer of a later step too.
    warnings.warn(f"{what}: {message}", RuntimeWarning, stacklevel=1)
    return message

"""Steps of the start that all ranks of a job do together, or none goes on."""

from __future__ import annotations

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
"""What a rank hands to the others at each step: what the step returned, or why it failed."""


def all_or_none(group: Group, what: str, step: Callable[[], bytes]) -> npt.NDArray[np.uint8]:
    """Does a step of the start; returns what it returned on all ranks.

    Collective: all ranks of the job call it, and they go on together or not at all.

    Args:
      group: this rank's use of the shared block.
      what: what cannot be had if the step fails, for the message.
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
        message = " ".join(str(error).split())
        note, has_failed = f"{message or type(error).__name__}".encode()[:NOTE_BYTES], True
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

"""The heartbeat file: how a GMI says how far it is, and how the controller reads it.

Format: `{"state": ..., "iteration": ..., "pid": ...}`, replaced as a whole at every beat.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from gmijax.rundir import write_json

GmiState = Literal["starting", "compiling", "ready", "running", "done"]

STATES: tuple[str, ...] = get_args(GmiState)
"""The states of a GMI in the order in which it reaches them."""


class Heartbeat(NamedTuple):
    """What a GMI last said about itself.

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


def write_heartbeat(path: Path, beat: Heartbeat) -> None:
    """Replaces the heartbeat file at `path`."""
    write_json(path, beat._asdict())


def read_heartbeat(path: Path) -> Heartbeat | None:
    """The last beat, or None where there is none (yet) or it is not one of ours."""
    try:
        beat = Heartbeat(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return beat if beat.state in STATES else None

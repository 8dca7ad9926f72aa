"""What is asked of the loop, by the page and by others. No jax here.

viser calls its callbacks in threads of its own, and only the loop may touch the simulation: they
put one of these into a queue.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

Point: TypeAlias = npt.NDArray[np.floating]


class Pause(NamedTuple):
    """Stop, or continue."""

    paused: bool


class StepRequest(NamedTuple):
    """Pause, and take one control step."""


class Reset(NamedTuple):
    """Begin new episodes in all environments."""


class SetSpeed(NamedTuple):
    """Simulated seconds per second."""

    speed: float


class Push(NamedTuple):
    """Change the velocity of the robot in the selected environment at once, m/s."""

    speed_m_per_s: float


class Drag(NamedTuple):
    """The mouse pulls at a body.

    Attributes:
      env: number of the environment.
      body: of the model.
      grabbed: [3] the point that was taken hold of, where it is now, m, in that environment.
      pointer: [3] where it is pulled to; None: the mouse has let go.
    """

    env: int
    body: int
    grabbed: Point
    pointer: Point | None


class SetCommand(NamedTuple):
    """The command of the robots; None: what the task draws."""

    command: tuple[float, ...] | None


class Select(NamedTuple):
    """Look at another environment."""

    env: int


class FollowRobot(NamedTuple):
    """Keep the selected robot in the middle, or not."""

    on: bool


class FollowTraining(NamedTuple):
    """Take every new checkpoint, or not."""

    on: bool


class UseCheckpoint(NamedTuple):
    """Act with the policy of this checkpoint, and follow no others."""

    checkpoint: Path


class Wake(NamedTuple):
    """A client has opened the page."""


Request: TypeAlias = (
    Pause
    | StepRequest
    | Reset
    | SetSpeed
    | Push
    | Drag
    | SetCommand
    | Select
    | FollowRobot
    | FollowTraining
    | UseCheckpoint
    | Wake
)

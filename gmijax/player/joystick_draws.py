"""Commands and pushes of Playground's joystick tasks, drawn in numpy as in training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

_HALF: Final = 0.5
"""Of a push by a force: with a half sine of this height it changes the velocity by 1/pi of it."""


class Commands:
    """Draws commands as Playground does."""

    def __init__(self, about: Mapping[str, Any], rng: np.random.Generator) -> None:
        self._about, self._rng = about["commands"], rng
        self._dt_s = about["control_dt_s"]
        self._left = 0

    def begin(self) -> npt.NDArray[Any]:
        """The first command of an episode [3]."""
        self._left = self._steps()
        if "largest" in self._about:
            return self._rng.uniform(-1, 1, 3) * self._about["largest"]
        return self._draw(np.zeros(3))

    def next(self, command: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The command of the next step, given that of this one."""
        self._left -= 1
        if self._left > 0:
            return command
        self._left = self._steps()
        return self._draw(command)

    def _steps(self) -> int:
        if "every_s" in self._about:
            return round(self._about["every_s"] / self._dt_s)
        return round(self._rng.exponential(self._about["mean_s"]) / self._dt_s)

    def _draw(self, command: npt.NDArray[Any]) -> npt.NDArray[Any]:
        rng, about = self._rng, self._about
        if "ranges" in about:
            low, high = np.array(about["ranges"]).T
            return np.zeros(3) if rng.random() < about["zero"] else rng.uniform(low, high)
        drawn = rng.uniform(-1, 1, 3) * about["largest"] * (rng.random(3) < about["nonzero"])
        return np.where(rng.random(3) < 0.5, drawn, command)


class Kicks:
    """G1, T1: sudden changes of the velocity, at the same intervals all episode long."""

    def __init__(self, about: Mapping[str, Any], rng: np.random.Generator) -> None:
        self._about, self._rng = about["pushes"], rng
        self._dt_s = about["control_dt_s"]

    def begin(self) -> None:
        """Draws what an episode has of its own."""
        self._every = round(self._rng.uniform(*self._about["every_s"]) / self._dt_s)
        self._step = 0

    def push(self, data: Any) -> bool:
        """Pushes if it is time to; whether it did."""
        self._step += 1
        if self._step % self._every:
            return False
        angle = self._rng.uniform(0, 2 * np.pi)
        size = self._rng.uniform(*self._about["change_m_per_s"])
        data.qvel[:2] += size * np.array([np.cos(angle), np.sin(angle)])
        return True


class Forces:
    """Go1, Spot: forces of a half sine over time, all of one size in an episode."""

    def __init__(self, about: Mapping[str, Any], model: Any, rng: np.random.Generator) -> None:
        self._about, self._rng = about["pushes"], rng
        self._dt_s = about["control_dt_s"]
        self._body = model.body(self._about["body"]).id
        self._mass_kg = model.body_subtreemass[self._body]

    def begin(self) -> None:
        """Draws what an episode has of its own."""
        about, rng = self._about, self._rng
        self._wait = round(rng.uniform(*about["wait_s"]) / self._dt_s)
        self._duration_s = rng.uniform(*about["duration_s"])
        self._steps = round(self._duration_s / self._dt_s)
        self._size = rng.uniform(*about["velocity_kick_m_per_s"])
        self._since = self._pushed = 0
        self._direction = np.zeros(2)

    def push(self, data: Any) -> bool:
        """Pushes while it is time to; whether it did."""
        data.xfrc_applied[:] = 0
        if self._since < self._wait:
            self._since += 1
            if self._since >= self._wait:
                angle = self._rng.uniform(0, 2 * np.pi)
                self._direction, self._pushed = np.array([np.cos(angle), np.sin(angle)]), 0
            return False
        wave = _HALF * np.sin(np.pi * self._pushed * self._dt_s / self._duration_s)
        force_n = wave * self._mass_kg * self._size / self._duration_s
        data.xfrc_applied[self._body, :2] = force_n * self._direction
        if self._pushed >= self._steps:
            self._since = 0
        self._pushed += 1
        return bool(force_n)


def pusher_of(about: Mapping[str, Any], model: Any, rng: np.random.Generator) -> Kicks | Forces:
    """What pushes a robot; `about` is its metadata in an export."""
    return Forces(about, model, rng) if "body" in about["pushes"] else Kicks(about, rng)

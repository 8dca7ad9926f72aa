"""The loop of the viewer: steps on time, pictures, requests. No jax and no viser here."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from gmijax.viewer import checkpoints, requests
from gmijax.viewer.checkpoints import Checkpoints
from gmijax.viewer.simulation import Policy, Simulation

PICTURE_S: Final = 1.0 / 50.0
"""Least time between two pictures."""

TEXT_S: Final = 0.2
LOOK_S: Final = 2.0
IDLE_S: Final = 60.0
"""Time without a client after which nothing is simulated."""

_LATE_S: Final = 0.1
"""A loop that is later than this gives up what it has missed."""

_RATE_S: Final = 1.0
"""The speed that is shown is that of at least so long."""


class View(NamedTuple):
    """What the page shows beside the bodies.

    Attributes:
      paused: nothing moves.
      is_late: the machine is too slow for the wanted speed.
      rate: simulated seconds per second, lately.
      selected: the environment of which numbers are shown.
      follow_robot: its robot stays in the middle.
      follow_training: every new checkpoint is taken.
      checkpoint: whose policy acts; None: it is none of a run.
      checkpoint_age_s: seconds since it was written, None if it is gone.
      checkpoints: those that can be chosen.
      problem: what did not work, one line, or nothing.
    """

    paused: bool
    is_late: bool
    rate: float
    selected: int
    follow_robot: bool
    follow_training: bool
    checkpoint: Path | None
    checkpoint_age_s: float | None
    checkpoints: tuple[Path, ...]
    problem: str


class Page(Protocol):
    """What the loop draws on."""

    def num_clients(self) -> int:
        """How many have the page open."""
        ...

    def draw(self, simulation: Simulation, view: View) -> None:
        """Shows the bodies, at most 50 times a second."""
        ...

    def write(self, simulation: Simulation, view: View) -> None:
        """Shows the numbers, 5 times a second."""
        ...


class Loop:
    """Runs a simulation at the wanted speed, and does what is asked of it.

    Args:
      simulation: what is stepped; nothing else touches it.
      page: what is drawn on.
      asked: requests (`gmijax.viewer.requests`), from any thread.
      run: the checkpoints of a run; None: there is only the policy of the simulation.
      checkpoint: of that policy.
      clock: seconds, of which only differences count.
    """

    def __init__(
        self,
        simulation: Simulation,
        page: Page,
        asked: queue.SimpleQueue[requests.Request],
        *,
        run: Checkpoints | None = None,
        checkpoint: Path | None = None,
        follow_training: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._simulation, self._page, self._asked = simulation, page, asked
        self._run, self._clock = run, clock
        now = clock()
        self._speed = 1.0
        self._next_step = self._next_picture = self._next_text = self._next_look = now
        self._seen_client = now
        self._rate_since, self._rate_steps = now, 0
        self.view = View(
            paused=False,
            is_late=False,
            rate=0.0,
            selected=0,
            follow_robot=True,
            follow_training=follow_training and run is not None,
            checkpoint=checkpoint,
            checkpoint_age_s=None,
            checkpoints=(),
            problem="",
        )

    @property
    def is_idle(self) -> bool:
        """Whether no client has looked for a while."""
        return self._clock() - self._seen_client > IDLE_S

    def run(self) -> None:
        """Runs until the process is interrupted."""
        while True:
            self.turn()
            self._wait()

    def turn(self) -> None:
        """Does what is due by now."""
        now = self._clock()
        if self._page.num_clients():
            self._seen_client = now
        if now >= self._next_look:
            self._next_look = now + LOOK_S
            self._look()
        if not (self.view.paused or self.is_idle):
            self._step(now)
        if self.is_idle:
            return
        if now >= self._next_picture:
            self._next_picture = max(self._next_picture + PICTURE_S, now)
            self._page.draw(self._simulation, self.view)
        if now >= self._next_text:
            self._next_text = now + TEXT_S
            self._measure(now)
            self._page.write(self._simulation, self.view)

    def _wait(self) -> None:
        """Waits for what is due next, or for a request, which is done at once."""
        if self.is_idle:
            due = self._next_look
        else:
            due = min(self._next_picture, self._next_text)
            if not self.view.paused:
                due = min(due, self._next_step)
        try:
            self.do(self._asked.get(timeout=max(0.0, due - self._clock())))
            while True:
                self.do(self._asked.get_nowait())
        except queue.Empty:
            return

    def _step(self, now: float) -> None:
        dt = self._simulation.control_dt_s / self._speed
        if now - self._next_step > _LATE_S:  # Rather slow than in a hurry.
            self._next_step = now
        if now >= self._next_step:
            self._simulation.step()
            self._rate_steps += 1
            self._next_step += dt

    def _measure(self, now: float) -> None:
        passed = now - self._rate_since
        if passed < _RATE_S:
            return
        rate = self._rate_steps * self._simulation.control_dt_s / passed
        self._change(rate=rate, is_late=not self.view.paused and rate < 0.9 * self._speed)
        self._rate_since, self._rate_steps = now, 0

    def _change(self, **changes: Any) -> None:
        self.view = self.view._replace(**changes)

    def do(self, request: requests.Request) -> None:
        """Does what is asked."""
        match request:
            case requests.Pause(paused):
                self._pause(paused)
            case requests.SetSpeed(speed):
                self._speed = speed
                self._restart_clock()
            case requests.Select(env):
                self._change(selected=min(max(env, 0), len(self._simulation.envs) - 1))
            case requests.FollowRobot(on):
                self._change(follow_robot=on)
            case requests.FollowTraining(on):
                self._change(follow_training=on and self._run is not None)
                self._look()
            case requests.UseCheckpoint(checkpoint):
                if self._use(checkpoint):
                    self._change(follow_training=False)
            case requests.Wake():
                self._seen_client = self._clock()
                self._restart_clock()
            case _:
                self._do_in_simulation(request)

    def _do_in_simulation(
        self,
        request: requests.StepRequest
        | requests.Reset
        | requests.Push
        | requests.Drag
        | requests.SetCommand,
    ) -> None:
        match request:
            case requests.StepRequest():
                self._pause(True)
                self._simulation.step()
            case requests.Reset():
                self._simulation.reset()
            case requests.Push(speed_m_per_s):
                self._simulation.push(self.view.selected, speed_m_per_s)
            case requests.Drag():
                self._simulation.drag(request)
            case requests.SetCommand(command):
                self._simulation.set_command(command)

    def _pause(self, paused: bool) -> None:
        self._change(paused=paused)
        self._restart_clock()

    def _restart_clock(self) -> None:
        now = self._clock()
        self._next_step = self._next_picture = self._next_text = now
        self._rate_since, self._rate_steps = now, 0

    def _look(self) -> None:
        """Looks for new checkpoints, and takes the newest one if they are followed."""
        if self._run is None:
            return
        found = tuple(self._run.look())
        self._change(checkpoints=found)
        if self.view.follow_training and found and found[-1] != self.view.checkpoint:
            self._use(found[-1])
        elif self.view.problem:
            self._change(problem="")
        if self.view.checkpoint is not None:
            self._change(checkpoint_age_s=checkpoints.age_s(self.view.checkpoint))

    def _use(self, checkpoint: Path) -> bool:
        """Acts by the policy of a checkpoint; False where it has none."""
        policy: Policy | None = checkpoints.read(checkpoint)
        if policy is None:  # The next look finds others.
            self._change(problem=f"{checkpoints.label(checkpoint)}: gone, damaged, or no policy")
            return False
        self._simulation.policy = policy
        self._change(checkpoint=checkpoint, problem="")
        return True
